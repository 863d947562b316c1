# SPDX-License-Identifier: Apache-2.0
"""Attention biases as compiled code, if no gradient is needed: one pass, without large intermediate tensors."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.geometry.compiled import compiled
from dpm2_core.network.precision import product_type

Array = NDArray[np.float32]
Bits = NDArray[np.int16]  # of bfloat16, or twice as many elements of float32

DIRECTIONS, DISTANCES = 5, 5  # number of functions of direction, then of distance


def applies(x: Tensor) -> bool:
    """Whether the biases of this tensor are computed here: on a CPU, without a gradient."""
    return x.device.type == "cpu" and not torch.is_grad_enabled()


def relative_bias(xyz: Tensor, axis: Tensor, weight: Tensor, reach: tuple[float, ...]) -> Tensor:
    """Weighted sums (B, M, N, N) of `attention.RelativeBias.basis` of xyz (B, N, 3) m with axes (B, N, 2); bf16 under
    autocast.

    Args:
        weight: (M, DIRECTIONS + DISTANCES). reach: (DISTANCES,) m, of the functions of distance.
    """
    out = torch.empty(len(xyz), len(weight), xyz.shape[1], xyz.shape[1], dtype=product_type(xyz.float()))
    for points, axes, bits in zip(xyz.float().numpy(), axis.float().numpy(), _bits(out), strict=True):
        fields = np.ascontiguousarray(points.T), np.ascontiguousarray(axes), weight.detach().numpy()
        _relative_bias_of_set(*fields, _rates(tuple(1 / r for r in reach)), bits)
    return out


def near_bias(distance: Tensor, counted: Tensor, alphas: tuple[float, ...]) -> Tensor:
    """The z-scores (B, len(alphas), N, T) over the tokens of exp(-alpha distance), 0 where not counted; bf16 under
    autocast.

    Args:
        distance: (B, N, T), m. counted: (B, N, T). alphas: 1/m.
    """
    out = torch.empty(len(distance), len(alphas), *distance.shape[1:], dtype=product_type(distance.float()))
    for row in zip(distance.float().contiguous().numpy(), counted.contiguous().numpy(), _bits(out), strict=True):
        _near_bias_of_set(row[0], row[1], _rates(alphas), row[2])
    return out


def _bits(biases: Tensor) -> Bits:
    bits: Bits = biases.view(torch.int16).numpy()
    return bits


def _rates(alphas: tuple[float, ...]) -> Array:
    """Rates for which 2^(rate x) is exp(-alpha x)."""
    return np.array(alphas, np.float32) * np.float32(-math.log2(math.e))


@compiled("void(f4[::1], f4, f4[::1])")
def _power_of_two(x: Array, rate: float, out: Array) -> None:
    """2^(rate x) for a negative rate, to 3e-7: the integer part as an exponent, the rest by a polynomial."""
    exponent = np.empty(len(out), np.int32)
    power = exponent.view(np.float32)
    for j in range(len(out)):
        y = max(x[j] * rate, np.float32(-120))
        floor = np.floor(y)
        exponent[j] = (np.int32(floor) + np.int32(127)) << np.int32(23)
        y -= floor
        high = np.float32(0.05582631) + y * (np.float32(0.00898934) + y * np.float32(0.00187757))
        out[j] = np.float32(1) + y * (np.float32(0.69315308) + y * (np.float32(0.24015361) + y * high))
    for j in range(len(out)):
        out[j] *= power[j]


@compiled("void(f4[::1], i2[::1])")
def _write_rounded(values: Array, out: Bits) -> None:
    """Copy the values as float32, or rounded to the nearest bfloat16 (ties to even) if `out` has no more room."""
    if len(out) > len(values):
        out.view(np.float32)[:] = values
        return
    bits = values.view(np.int32)
    for j in range(len(out)):
        out[j] = (bits[j] + np.int32(0x7FFF) + ((bits[j] >> np.int32(16)) & np.int32(1))) >> np.int32(16)


@compiled("void(f4[:, ::1], f4[:, ::1], i8, f4[:, ::1], f4[::1])")
def _directions_from(xyz: Array, axis: Array, i: int, directions: Array, distance: Array) -> None:
    """The functions of direction, and the distance, of all points (3, N) from point i."""
    c, s, one = axis[i, 0], axis[i, 1], np.float32(1)
    for j in range(len(distance)):
        x, y, z = xyz[0, j] - xyz[0, i], xyz[1, j] - xyz[1, i], xyz[2, j] - xyz[2, i]
        distance[j] = np.sqrt(x * x + y * y + z * z + np.float32(1e-9))
        inverse = one / (one + distance[j])
        forward, left = (c * x + s * y) * inverse, (c * y - s * x) * inverse
        directions[0, j], directions[1, j], directions[2, j] = forward, left, z * inverse
        directions[3, j], directions[4, j] = forward * forward, left * left


@compiled("void(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[::1], i2[:, :, ::1])")
def _relative_bias_of_set(xyz: Array, axis: Array, weight: Array, rates: Array, out: Bits) -> None:
    """`relative_bias` of one set (3, N). Every inner loop runs over the points, many at a time. The functions are
    written out, because a loop over them would write each sum ten times."""
    n = len(axis)
    f = np.empty((DIRECTIONS + DISTANCES, n), np.float32)
    distance, total = np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        _directions_from(xyz, axis, i, f, distance)
        for r in range(DISTANCES):
            _power_of_two(distance, rates[r], f[DIRECTIONS + r])
        for m in range(len(weight)):
            w = weight[m]
            for j in range(n):
                direction = w[0] * f[0, j] + w[1] * f[1, j] + w[2] * f[2, j] + w[3] * f[3, j] + w[4] * f[4, j]
                near = w[5] * f[5, j] + w[6] * f[6, j] + w[7] * f[7, j] + w[8] * f[8, j] + w[9] * f[9, j]
                total[j] = direction + near
            _write_rounded(total, out[m, i])


@compiled("void(f4[:, ::1], b1[:, ::1], f4[::1], i2[:, :, ::1])")
def _near_bias_of_set(distance: Array, counted: NDArray[np.bool_], rates: Array, out: Bits) -> None:
    """`near_bias` of one set."""
    size = distance.shape[1]
    value, one = np.empty(size, np.float32), np.ones(size, np.float32)
    for r in range(len(rates)):
        for i in range(len(distance)):
            _power_of_two(distance[i], rates[r], value)
            for j in range(size):
                value[j] = value[j] if counted[i, j] else np.float32(0)
            value -= np.dot(value, one) / np.float32(size)
            value /= max(np.sqrt(np.dot(value, value) / np.float32(size)), np.float32(1e-4))
            _write_rounded(value, out[r, i])
