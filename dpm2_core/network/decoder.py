# SPDX-License-Identifier: Apache-2.0
"""Two descriptor sets become correlated descriptors: attention layers, and the heads that read them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor, nn

from dpm2_core.network.attention import Attention, RelativeBias, sine_code
from dpm2_core.network.heads import ConfidenceHead, OffsetHead, OverlapHead, PointMLP
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.tokens import Tokens


class Correlated(NamedTuple):
    """Features (B, N, C) and (B, M, C) after each set has seen the other."""

    source: Tensor
    target: Tensor


class Prepared(NamedTuple):
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

    def self_attend(self, x: Tensor, code: Tensor | None, bias: Tensor | None, mask: Tensor) -> Tensor:
        """Self-attention of a set x (B, N, C)."""
        x = x if code is None else x + code
        x = self.norms[0](x + self.self_attention(x, x, bias, mask))
        return x if code is None else x + code

    def cross_attend(self, x: Tensor, other: Tensor, other_mask: Tensor) -> Tensor:
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
        self.confidence = ConfidenceHead()
        self.overlap = OverlapHead(width, decoder.overlap_pose)
        self.overlap_trained = False  # until the overlap training has trained the head
        self.coarse = PointMLP(settings.channels)

    def forward(self, source: Tokens, target: Tokens) -> Correlated:
        """Correlate two batches of sets."""
        return self.correlate(self.prepare(source), self.prepare(target))

    def prepare(self, tokens: Tokens) -> Prepared:
        """The part of the correlation that depends on one set alone."""
        code: Tensor | None = None
        biases: Sequence[Tensor | None] = [None] * len(self.layers)
        if self.relative is None:
            code = sine_code(tokens.xyz, self.settings.width)
        else:
            biases = self.relative(tokens.xyz, tokens.axis)
        mask = tokens.mask[:, None, None]
        first = self.layers[0]
        assert isinstance(first, DecoderLayer)
        return Prepared(first.self_attend(self.project(tokens.features), code, biases[0], mask), code, biases, mask)

    def correlate(self, source: Prepared, target: Prepared) -> Correlated:
        """Correlate two batches of sets that are prepared."""
        x, y = source.features, target.features
        for i, layer in enumerate(self.layers):
            assert isinstance(layer, DecoderLayer)
            if i > 0:
                x = layer.self_attend(x, source.code, source.biases[i], source.mask)
                y = layer.self_attend(y, target.code, target.biases[i], target.mask)
            x, y = layer.cross_attend(x, y, target.mask), layer.cross_attend(y, x, source.mask)
        return Correlated(x, y)
