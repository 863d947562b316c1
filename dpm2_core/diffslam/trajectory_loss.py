# SPDX-License-Identifier: Apache-2.0
"""The SLAM loss (BMVC 2023, eq. 3): how far the trajectory of the predicted scans is from that of the target scans."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from dpm2_core.config import Settings
from dpm2_core.diffslam.clouds import window
from dpm2_core.diffslam.icp import Cloud, IcpSettings, matched, register
from dpm2_core.diffslam.relaxation import relax
from dpm2_core.diffslam.soft_lm import SoftLmSettings
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3_torch

Clouds = Sequence[Tensor] | Tensor
"""T tensors (N_t, 3), m, or one (T, N, 3)."""
Weights = Sequence[Tensor] | Tensor | None
"""T tensors (N_t,), or one (T, N), in 0..1; zero is padding; None is one everywhere."""


ROTATION_WEIGHT = 25.0
"""Weight of a squared angle relative to a squared distance, m2 / rad2: that of its displacement at 5 m."""

_SAME_FIRST_POSE = 1e-2  # m, rad: rounding in float32 of poses kilometers away


class SlamLossSettings(Settings):
    """Odometry over a window of scans, and the cost of its errors."""

    icp: IcpSettings = IcpSettings()
    """Registration of two scans."""
    points: int = Field(default=2048, ge=50)
    """Largest number of points of a scan."""
    voxel: float = Field(default=0.5, gt=0)
    """A scan with more points is first downsampled to one point per voxel of this edge, m."""
    spans: tuple[Annotated[int, Field(ge=1)], ...] = Field(default=(1,), min_length=1)
    """Scans this many steps apart are registered. Spans above 1 make a pose graph, which is relaxed."""
    graph: SoftLmSettings = SoftLmSettings(iterations=5)
    """Solver of that relaxation."""
    rotation_weight: float = Field(default=ROTATION_WEIGHT, ge=0)
    """Weight of a squared angle relative to a squared distance, m2 / rad2."""
    warm_start: bool = False
    """Both trajectories start at the solution of the target scans instead of the guess: for scans so far apart that the
    iterations do not converge from the guess. Without convergence a gradient means little."""
    truncate: int = Field(default=0, ge=0)
    """Number of scans of the trajectory after which gradients are cut, so that they do not explode in long windows.
    0: never. Only with spans of 1: a pose graph has no chain to cut."""

    placebo: bool = False
    """For experiments: a window is compared with the reference of the window before; the first one with its own
    trajectory, at no cost. Loss and bound are the same, but the loss has no information."""

    @model_validator(mode="after")
    def _check_truncate(self) -> Self:
        if self.truncate and set(self.spans) != {1}:
            raise ValueError("truncate needs spans of 1: a pose graph has no chain to cut")
        return self


def squared_errors(poses: Tensor, reference: Tensor, rotation_weight: float = ROTATION_WEIGHT) -> Tensor:
    """|t - t_ref|^2 + rotation_weight |Log(R_ref^T R)|^2 of poses (N, 4, 4), m2: (N,)."""
    translation = (poses[:, :3, 3] - reference[:, :3, 3]).square().sum(-1)
    rotation = se3_torch.log_rotation(reference[:, :3, :3].mT @ poses[:, :3, :3]).square().sum(-1)
    return translation + rotation_weight * rotation


def trajectory_loss(poses: Tensor, reference: Tensor, rotation_weight: float = ROTATION_WEIGHT) -> Tensor:
    """Eq. 3: mean of `squared_errors` over all poses except the first; a scalar, m2.

    Args:
        poses: (T, 4, 4) T_map_scan of the scans, relative to the first.
        reference: the same of the same scans, without gradient.
        rotation_weight: m2 / rad2.

    Raises:
        UsageError: shapes differ, there is no second pose, or the first poses differ.
    """
    if poses.shape != reference.shape or poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2:
        raise UsageError(
            f"trajectory loss: poses {tuple(poses.shape)} against {tuple(reference.shape)}; want (T, 4, 4)"
        )
    poses, reference = poses.double(), reference.detach().double()
    if bool((poses[0].detach() - reference[0]).abs().max() > _SAME_FIRST_POSE):
        raise UsageError("trajectory loss: the first poses differ; want both trajectories relative to their first pose")
    return squared_errors(poses[1:], reference[1:], rotation_weight).mean()


def odometry(clouds: Clouds, weights: Weights = None, guess: Tensor | None = None,
             settings: SlamLossSettings | None = None, name: str = "scans") -> Tensor:  # fmt: skip
    """Trajectory (T, 4, 4) T_first_scan float64 of T contiguous scans, differentiable in points and weights.

    Steps are registered in one batch, each from the guess; then longer spans, from the poses that the steps give. A
    pair without evidence (weights of zero) keeps its start, and has no weight if there are longer spans.

    Args:
        guess: (4, 4) or (T - 1, 4, 4) motion from a scan to the next, T_scan_next, without gradient; identity if None.

    Raises:
        UsageError: see `clouds.window`; or the guess has another shape.
    """
    settings = settings or SlamLossSettings()
    points, w = window(clouds, weights, settings.points, settings.voxel, name)
    scans = Cloud(points, w)
    steps = _edges([1], len(points))
    step_poses, step_shares = _register(scans, steps, _guessed_steps(guess, points), settings.icp)
    poses = chained(step_poses, settings.truncate)
    longer = _edges(sorted(set(settings.spans) - {1}), len(points))
    if not len(longer):
        return poses
    start = poses.detach()
    longer_init = se3_torch.inverse(start[longer[:, 0]]) @ start[longer[:, 1]]
    longer_poses, longer_shares = _register(scans, longer, longer_init, settings.icp)
    edges, measured, shares = (
        torch.cat([steps, longer]),
        torch.cat([step_poses, longer_poses]),
        torch.cat([step_shares, longer_shares]),
    )
    return relax(start, edges, measured, shares, settings.rotation_weight, settings.graph)


class SlamLoss(torch.nn.Module):
    """`loss = SlamLoss()(pred_clouds, target_clouds, weights)`; add it to the loss of the task, never alone.

    The reference is the trajectory of the same SLAM on the target scans: no ground truth is needed.
    """

    def __init__(self, settings: SlamLossSettings | None = None) -> None:
        """Default settings if None."""
        super().__init__()
        self.settings = settings or SlamLossSettings()
        self._references: dict[tuple[tuple[str, int], ...], tuple[Tensor, Tensor | None]] = {}
        self._previous_reference: Tensor | None = None

    def forward(
        self,
        pred_clouds: Clouds,
        target_clouds: Clouds,
        weights: Weights = None,
        target_weights: Weights = None,
        *,
        guess: Tensor | None = None,
        frames: Sequence[tuple[str, int]] | None = None,
    ) -> Tensor:
        """Scalar float64, m2; zero, with zero gradient, if prediction and target are the same.

        Args:
            pred_clouds: a window of T scans. target_clouds: of the same scans; the counts of points may differ.
            weights: of the predicted points, with gradient: a selection acts on the loss through them. target_weights:
                without gradient.
            guess: see `odometry`, for both. frames: (sequence, number) of each scan. With them the window is checked to
                be contiguous, and the reference is computed once and cached: only if the targets are always the same.

        Raises:
            UsageError: see `clouds.window`; the windows differ in length; or they are not contiguous.
        """
        if len(pred_clouds) != len(target_clouds):
            raise UsageError(f"SLAM loss: {len(pred_clouds)} predicted scans for {len(target_clouds)} targets")
        if frames is not None:
            check_contiguous(frames, len(pred_clouds))
        reference, guess = self._reference(target_clouds, target_weights, guess, frames)
        poses = odometry(pred_clouds, weights, guess, self.settings, "predicted clouds")
        if self.settings.placebo:
            reference, self._previous_reference = (
                poses.detach() if self._previous_reference is None else self._previous_reference,
                reference,
            )
        return trajectory_loss(poses, reference.to(poses.device), self.settings.rotation_weight)

    def restart(self) -> None:
        """Drop the window before; for the start of an epoch, so that a resumed training continues in the same way."""
        self._previous_reference = None

    @torch.no_grad()
    def _reference(self, clouds: Clouds, weights: Weights, guess: Tensor | None,
                   frames: Sequence[tuple[str, int]] | None) -> tuple[Tensor, Tensor | None]:  # fmt: skip
        """The trajectory of the target scans, and the guess from which both trajectories start."""
        key = tuple(frames) if frames is not None else ()
        if key and key in self._references:
            return self._references[key]
        poses = odometry(clouds, weights, guess, self.settings, "target clouds")
        if self.settings.warm_start:
            guess = se3_torch.inverse(poses[:-1]) @ poses[1:]
            poses = odometry(clouds, weights, guess, self.settings, "target clouds")
        if key:
            self._references[key] = poses, guess
        return poses, guess


def check_contiguous(frames: Sequence[tuple[str, int]], length: int) -> None:
    """Raise UsageError unless the scans are of one sequence, equally far apart and in their order."""
    if len(frames) != length:
        raise UsageError(f"window: {len(frames)} frames are named for {length} scans")
    names, numbers = zip(*frames, strict=True)
    if len(set(names)) > 1:
        raise UsageError(f"window: crosses the border of sequences {names[0]} and {names[-1]}")
    gaps = {b - a for a, b in pairwise(numbers)}
    if len(gaps) != 1 or min(gaps) < 1:
        raise UsageError(f"window: frames {list(numbers)} of sequence {names[0]} are not contiguous")


def _edges(spans: Sequence[int], scans: int) -> Tensor:
    """(E, 2) pairs (target, source) of scans that are these spans apart."""
    return torch.tensor([(i, i + span) for span in spans for i in range(scans - span)], dtype=torch.int64).view(-1, 2)


def _register(scans: Cloud, edges: Tensor, T_init: Tensor, settings: IcpSettings) -> tuple[Tensor, Tensor]:
    """T_target_source (E, 4, 4) of pairs of scans, and (E,) the matched share of each source, 0..1."""
    target, source = scans.select(edges[:, 0].tolist()), scans.select(edges[:, 1].tolist())
    found = register(source, target, T_init, settings)
    return found, matched(source, target, found.detach(), settings)


def _guessed_steps(guess: Tensor | None, points: Tensor) -> Tensor:
    steps = torch.eye(4, dtype=points.dtype, device=points.device) if guess is None else guess.detach().to(points)
    if steps.shape not in ((4, 4), (len(points) - 1, 4, 4)):
        raise UsageError(f"guess: shape {tuple(steps.shape)}; want (4, 4) or ({len(points) - 1}, 4, 4)")
    return steps.expand(len(points) - 1, 4, 4)


def chained(steps: Tensor, truncate: int = 0) -> Tensor:
    """Poses (..., T, 4, 4) from the motions (..., T - 1, 4, 4) between them, the first the identity; for `truncate`
    see `SlamLossSettings`."""
    poses = [torch.eye(4, dtype=steps.dtype, device=steps.device).expand(*steps.shape[:-3], 4, 4)]
    for i, step in enumerate(steps.unbind(-3)):
        last = poses[-1].detach() if truncate and i % truncate == 0 else poses[-1]
        poses.append(last @ step)
    return torch.stack(poses, -3)
