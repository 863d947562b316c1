# SPDX-License-Identifier: Apache-2.0
"""Two descriptor sets become correlated descriptors, and those a pose or an overlap probability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Array, Registration
from dpm2_core.network.attention import Attention, RelativeBias, sine_code
from dpm2_core.network.heads import OffsetHead, OverlapHead, PointMLP
from dpm2_core.network.pose_solver import Solved, correspond, evidence, match_scores, register_batch
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.tokens import Tokens, to_tokens


class Correlated(NamedTuple):
    """Features (B, N, C) and (B, M, C) after each set has seen the other."""

    source: Tensor
    target: Tensor


class _Alone(NamedTuple):
    """A set after its first self-attention (B, N, C), its position code or attention bias per layer, and its mask."""

    features: Tensor
    code: Tensor | None
    biases: Sequence[Tensor | None]
    mask: Tensor


class DecoderLayer(nn.Module):
    """Self-attention, cross-attention, MLP, each with a residual and LayerNorm; weights shared by both sets."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.self_attention = Attention(width, heads)
        self.cross_attention = Attention(width, heads)
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))

    def alone(self, x: Tensor, code: Tensor | None, bias: Tensor | None, mask: Tensor) -> Tensor:
        """Self-attention of a set x (B, N, C)."""
        x = x if code is None else x + code
        x = self.norms[0](x + self.self_attention(x, x, bias, mask))
        return x if code is None else x + code

    def across(self, x: Tensor, other: Tensor, other_mask: Tensor) -> Tensor:
        """Cross-attention of x (B, N, C) to other (B, M, C), then the MLP."""
        x = self.norms[1](x + self.cross_attention(x, other, None, other_mask))
        return self.norms[2](x + self.mlp(x))


class Decoder(nn.Module):
    """Transformer over two sets with its heads."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        decoder = settings.decoder
        width = decoder.width
        self.settings = decoder
        self.view_aligned = settings.points.view_aligned
        self.project = nn.Linear(settings.channels, width)
        self.layers = nn.ModuleList(DecoderLayer(width, decoder.heads) for _ in range(decoder.layers))
        self.relative = RelativeBias(decoder.layers, decoder.heads) if decoder.position == "relative" else None
        self.similarity = PointMLP(width)
        self.offset = OffsetHead(width, decoder.precision)
        self.overlap = OverlapHead(width, decoder.overlap_pose)
        self.judges_overlap = False  # until phase two has trained the head
        self.coarse = PointMLP(settings.channels)
        self._kept: tuple[Descriptors, Tokens, _Alone] | None = None

    def forward(self, source: Tokens, target: Tokens) -> Correlated:
        """Correlate two batches of sets."""
        return self._correlate(self._alone(source), self._alone(target))

    def _alone(self, tokens: Tokens) -> _Alone:
        """What a set's part in the correlation is before it has seen another one."""
        code: Tensor | None = None
        biases: Sequence[Tensor | None] = [None] * len(self.layers)
        if self.relative is None:
            code = sine_code(tokens.xyz, self.settings.width)
        else:
            biases = self.relative(tokens.xyz, tokens.axis)
        mask = tokens.mask[:, None, None]
        first = self.layers[0]
        assert isinstance(first, DecoderLayer)
        return _Alone(first.alone(self.project(tokens.features), code, biases[0], mask), code, biases, mask)

    def _correlate(self, source: _Alone, target: _Alone) -> Correlated:
        x, y = source.features, target.features
        for i, layer in enumerate(self.layers):
            assert isinstance(layer, DecoderLayer)
            if i > 0:
                x = layer.alone(x, source.code, source.biases[i], source.mask)
                y = layer.alone(y, target.code, target.biases[i], target.mask)
            x, y = layer.across(x, y, target.mask), layer.across(y, x, source.mask)
        return Correlated(x, y)

    @torch.inference_mode()
    def register(self, source: Descriptors, target: Descriptors) -> Registration:
        """Pose of the source in the frame of the target; either may be merged from several frames.

        The target's part of the work is kept for the next call with the same object, such as the map of an odometry.
        """
        device = next(self.parameters()).device
        x = to_tokens([source], self.view_aligned, device)
        with torch.autocast(device.type, torch.bfloat16):
            if self._kept is None or self._kept[0] is not target:
                y = to_tokens([target], self.view_aligned, device)
                self._kept = (target, y, self._alone(y))
            _, y, alone = self._kept
            return register_batch(self, x, y, self._correlate(self._alone(x), alone))[0]

    @torch.inference_mode()
    def register_many(self, sources: list[Descriptors], targets: list[Descriptors]) -> list[Registration]:
        """`register` for a batch of pairs; nothing is kept."""
        device = next(self.parameters()).device
        source = to_tokens(sources, self.view_aligned, device)
        target = to_tokens(targets, self.view_aligned, device)
        with torch.autocast(device.type, torch.bfloat16):
            return register_batch(self, source, target, self(source, target))

    @torch.inference_mode()
    def matches(self, source: Descriptors, target: Descriptors) -> tuple[Array, Array, Array]:
        """The descriptors that `register` pairs: positions (K, 3) in each frame, m, and confidence (K,) 0..1."""
        device = next(self.parameters()).device
        x, y = (to_tokens([descriptors], self.view_aligned, device) for descriptors in (source, target))
        with torch.autocast(device.type, torch.bfloat16):
            correlated = self(x, y)
            pairs = correspond(self, x, y, correlated, match_scores(self, correlated))
        half = pairs.weight.shape[1] // 2  # then the same pairs again, in the other direction
        at_source, at_target = pairs.source[0, half:].double().cpu(), pairs.target[0, :half].double().cpu()
        return at_source.numpy(), at_target.numpy(), pairs.weight[0, :half].double().cpu().numpy()

    def judge_overlap(self, source: Tokens, target: Tokens, correlated: Correlated, solved: Solved) -> Tensor:
        """Probability (B,) that each pair was seen from within 20 m; NaN while the head is untrained."""
        if not self.judges_overlap:
            return torch.full(source.mask.shape[:1], torch.nan)
        return self.overlap(*correlated, source.mask, target.mask, evidence(solved)).sigmoid()
