# SPDX-License-Identifier: Apache-2.0
"""Heads on (correlated) descriptors: similarity, offset with precision, and the coarse pairing for training. Heads on
the resulting poses: confidence and overlap."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpm2_core.network.pointnext import from_view, to_view


class PointMLP(nn.Sequential):
    """Two point-wise layers: similarity head (width, width) and coarse pairing head (channels, channels)."""

    def __init__(self, width: int) -> None:
        super().__init__(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))


class OffsetHead(nn.Module):
    """Offset from descriptor a to the point that corresponds to descriptor b, and its precision.

    The offset is in a's view frame, so that its covariance rotates with the surfaces when the sensor rotates.
    """

    def __init__(self, width: int, precision: bool) -> None:
        super().__init__()
        self.precision = precision
        self.deep = nn.Sequential(
            nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, width // 2), nn.ReLU(),
            nn.Linear(width // 2, width // 4),
        )  # fmt: skip
        self.skip = nn.Linear(2 * width, width // 4)
        self.out = nn.Linear(width // 4, 9 if precision else 3)
        nn.init.zeros_(
            self.out.weight
        )  # no offset, 0.5 m: no steep gradients of the likelihood before the features are trained
        nn.init.zeros_(self.out.bias)

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """a, b (..., C): offset (..., 3), m, and lower-triangular L (..., 3, 3), 1/m, of the precision L L^T.

        Without predicted precision L is the identity.
        """
        pair = torch.cat([a, b], -1)
        out = self.out(torch.relu(self.deep(pair) + self.skip(pair))).float()
        offset = out[..., :3]
        if not self.precision:
            return offset, torch.eye(3, device=out.device).expand(*out.shape[:-1], 3, 3)
        diagonal = torch.exp(out[..., 3:6].clamp(-5, 5) + 0.7)  # starts at a deviation of 0.5 m
        zero = torch.zeros_like(offset[..., 0])
        lower = out[..., 6:] * diagonal  # relative to its row's scale
        L = torch.stack(
            [
                diagonal[..., 0], zero, zero,
                lower[..., 0], diagonal[..., 1], zero,
                lower[..., 1], lower[..., 2], diagonal[..., 2],
            ],
            -1,
        )  # fmt: skip
        return offset, L.unflatten(-1, (3, 3))


CONFIDENCE_FEATURES = 5  # of `solved.confidence_features`


class ConfidenceHead(nn.Linear):
    """Logits (B,) that poses are right, from `solved.confidence_features` (B, CONFIDENCE_FEATURES).

    Its initial values are those of the shipped weights, for a network without overlap training.
    """

    def __init__(self) -> None:
        super().__init__(CONFIDENCE_FEATURES, 1)
        with torch.no_grad():
            self.weight.copy_(torch.tensor([[1.4, 13.2, -1.5, -8.3, 3.4]]))
            self.bias.fill_(-5.4)

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features)[..., 0].float()


POSE_FEATURES = 3  # of `solved.overlap_features`
_FEATURE_MEAN, _FEATURE_SCALE = (0.3, 1.0, 0.5), (0.15, 0.5, 0.15)  # of these: near and far pairs separate about there


class OverlapHead(nn.Module):
    """Probability that two frames are within 20 m.

    `pose`: from their registration: its confidence, the distance that it puts between them, and the share of pairs that
    fits. False: from the descriptors, as in the paper: point-wise layers, mean over the valid points, classifier. That
    head, trained the same way, hardly learned anything. One that read both had an average precision of 0.961 for a
    sensor without errors, unlike in training; the registration alone has 0.996 there.
    """

    def __init__(self, width: int, pose: bool) -> None:
        super().__init__()
        self.points = None if pose else PointMLP(width)
        inputs = POSE_FEATURES if pose else 2 * width
        self.classify = nn.Sequential(nn.Linear(inputs, 2 * width), nn.ReLU(), nn.Linear(2 * width, 1))

    def forward(
        self, source: Tensor, target: Tensor, source_mask: Tensor, target_mask: Tensor, overlap_features: Tensor
    ) -> Tensor:
        """Logits (B,) of source (B, N, C) and target (B, M, C) with masks (B, N) and (B, M), and
        `solved.overlap_features` (B, POSE_FEATURES); each mode reads only its own inputs."""
        if self.points is None:
            mean, scale = (overlap_features.new_tensor(values) for values in (_FEATURE_MEAN, _FEATURE_SCALE))
            return self.classify((overlap_features - mean) / scale)[..., 0].float()
        pooled = []
        for features, mask in ((source, source_mask), (target, target_mask)):
            weight = mask[..., None].to(features.dtype)
            pooled.append((self.points(features) * weight).sum(1) / weight.sum(1).clamp(min=1))
        return self.classify(torch.cat(pooled, -1))[..., 0].float()


def residuals_in_view(offset: Tensor, true: Tensor, axis: Tensor) -> Tensor:
    """Predicted offset (..., 3) in the view frame minus the true one (..., 3), given in the set's frame."""
    return offset - to_view(true, axis)


def into_set_frame(offset: Tensor, L: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate offset (..., 3) and L (..., 3, 3) from the view frame to the set's frame: R o and R L."""
    columns = from_view(L.transpose(-1, -2), axis[..., None, :])
    return from_view(offset, axis), columns.transpose(-1, -2)
