# SPDX-License-Identifier: Apache-2.0
"""Multi-head attention with a spatial bias: feature similarity plus the z-score of exp(-alpha distance)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dpm2_core.network import compiled_bias
from dpm2_core.network.precision import product_type


def effective_mask(mask: Tensor | None) -> Tensor | None:
    """The mask, or None if it hides nothing, as for one frame: saves passes. A GPU would have to wait for the check."""
    return None if mask is not None and mask.device.type == "cpu" and bool(mask.all()) else mask


def zscore(values: Tensor, mask: Tensor | None = None) -> Tensor:
    """Rows (..., T) to zero mean and unit deviation over the True tokens of the mask (..., T).

    A constant row, or one without any token, becomes zeros.
    """
    mask = effective_mask(mask)
    if mask is None:  # not by std_mean, which takes ten times as long on a CPU
        centered = values - values.mean(-1, keepdim=True)
        return centered / centered.square().mean(-1, keepdim=True).sqrt().clamp(min=1e-4)
    weight = mask.to(values.dtype).expand_as(values)
    count = weight.sum(-1, keepdim=True).clamp(min=1)
    mean = (values * weight).sum(-1, keepdim=True) / count
    centered = (values - mean) * weight
    deviation = ((centered * centered).sum(-1, keepdim=True) / count).sqrt()
    return centered / deviation.clamp(min=1e-4)


def sine_code(xyz: Tensor, width: int) -> Tensor:
    """Sine and cosine code of metric coordinates (..., 3): (..., width), zero-padded; temperature 10000, factor pi."""
    per_axis = width // 3 // 2 * 2
    rate = 10000 ** (-torch.arange(0, per_axis, 2, dtype=torch.float32, device=xyz.device) / per_axis)
    angle = xyz.float()[..., None] * math.pi * rate
    code = torch.stack([angle.sin(), angle.cos()], -1).flatten(-3)
    return nn.functional.pad(code, (0, width - code.shape[-1]))


class RelativeBias(nn.Module):
    """A learned attention bias that depends on the position of one point in the view-aligned frame of the other."""

    REACH = (1.0, 2.5, 6.0, 15.0, 40.0)  # m, of the radial basis functions

    def __init__(self, layers: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.weight = nn.Parameter(torch.zeros(layers, heads, compiled_bias.DIRECTIONS + compiled_bias.DISTANCES))

    @torch.no_grad()
    def basis(self, xyz: Tensor, axis: Tensor) -> Tensor:
        """xyz (B, N, 3) m, axis (B, N, 2): fixed functions (B, K, N, N), row i of points j as seen from i."""
        x, y, z = (xyz[..., None, :, i] - xyz[..., :, None, i] for i in range(3))
        c, s = axis[..., None, 0], axis[..., None, 1]
        distance = (x * x + y * y + z * z + 1e-9).sqrt()
        inverse = 1 / (1 + distance)
        forward, left = (c * x + s * y) * inverse, (c * y - s * x) * inverse
        near = [torch.exp(distance * (-1 / reach)) for reach in self.REACH]
        functions = [forward, left, z * inverse, forward * forward, left * left, *near]
        return torch.stack([f.to(product_type(xyz)) for f in functions], 1)

    def forward(self, xyz: Tensor, axis: Tensor) -> tuple[Tensor, ...]:
        """Bias (B, heads, N, N) of each layer, for xyz (B, N, 3) m with axes (B, N, 2)."""
        (batch, n, _), (layers, heads, functions) = xyz.shape, self.weight.shape
        weight = self.weight.view(layers * heads, functions)
        if compiled_bias.applies(xyz):
            bias = compiled_bias.relative_bias(xyz, axis, weight, self.REACH)
        else:
            basis = self.basis(xyz, axis).flatten(2)
            bias = torch.bmm(weight.to(basis.dtype).expand(batch, -1, -1), basis)
        return bias.view(batch, layers, heads, n, n).unbind(1)


class Attention(nn.Module):
    """Multi-head attention; a row without any token gives zeros."""

    def __init__(self, width: int, heads: int, learnable: bool = True) -> None:
        super().__init__()
        if width % heads:
            raise ValueError(f"attention width {width} is not a multiple of {heads} heads")
        self.heads = heads
        self.query = nn.Linear(width, width) if learnable else None
        self.key = nn.Linear(width, width) if learnable else None
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor, tokens: Tensor, bias: Tensor | None, mask: Tensor | None) -> Tensor:
        """Attend from x (B, N, C) to tokens (B, T, C): (B, N, C).

        Args:
            bias: (B, 1 or heads, N, T) added to the scaled products, or None.
            mask: True where a token may be read, broadcastable to (B, heads, N, T), or None.
        """
        batch, n, width = x.shape
        mask = effective_mask(mask)
        value = self._split(self.value(tokens))
        weights = self.weights(x, tokens, bias, mask)
        with torch.autocast(x.device.type, enabled=False):
            out = weights.to(value.dtype) @ value
        out = self.out(out.transpose(1, 2).reshape(batch, n, width))
        if mask is None:
            return out
        readable = mask.any(-1).any(1)[..., None]  # (B, N or 1, 1)
        return torch.where(readable, out, torch.zeros_like(out))

    def weights(self, x: Tensor, tokens: Tensor, bias: Tensor | None, mask: Tensor | None) -> Tensor:
        """Attention weights (B, heads, N, T), rows adding up to 1; arguments as for `forward`."""
        query = key = None
        if self.query is not None and self.key is not None:
            query, key = self._split(self.query(x)), self._split(self.key(tokens))
        # Written out: at these sizes twice as fast as the fused kernel on the CPU, and the bias can be learned. Softmax
        # stays in bf16 under autocast.
        with torch.autocast(x.device.type, enabled=False):
            if query is not None and key is not None:
                scores = (query / math.sqrt(x.shape[-1] // self.heads)) @ key.transpose(-1, -2)
                scores = scores if bias is None else scores.add_(bias.to(scores.dtype))
            elif bias is not None:
                scores = bias.expand(-1, self.heads, -1, -1).clone()
            else:
                raise ValueError("attention without learned similarity needs a spatial bias")
            if mask is not None:
                scores = scores.masked_fill_(~mask, -1e4)  # finite: a row without tokens stays free of NaN
            return scores.softmax(-1)

    def _split(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:2], self.heads, x.shape[2] // self.heads).transpose(1, 2)
