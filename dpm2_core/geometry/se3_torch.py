# SPDX-License-Identifier: Apache-2.0
"""SE(3) in torch, twice differentiable everywhere below pi; conventions of `se3`: [rotation, translation], T @ exp(xi).

Near the identity every function uses a series, since sin(theta)/theta and similar terms are 0/0 there. A `where` around
a division would leak its NaN into the gradient; so the argument is replaced before the division, not the result after.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.geometry.full_precision import full_precision

_SMALL = 1e-4  # rad: the series' first omitted term, theta^4 / 120, is below the rounding of float64


def hat(w: Tensor) -> Tensor:
    """(..., 3) to the (..., 3, 3) cross-product matrix."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def make(R: Tensor, t: Tensor) -> Tensor:
    """(..., 3, 3) and (..., 3) to (..., 4, 4)."""
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(*R.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R, t[..., None]], -1), last], -2)


def inverse(T: Tensor) -> Tensor:
    """Inverse of (..., 4, 4) rigid transforms."""
    R_inv = T[..., :3, :3].mT
    return make(R_inv, -(R_inv @ T[..., :3, 3:])[..., 0])


@full_precision
def transform(T: Tensor, points: Tensor) -> Tensor:
    """T (..., 4, 4) applied to points (..., N, 3), in the dtype of the points."""
    T = T.to(points.dtype)
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def exp(xi: Tensor) -> Tensor:
    """(..., 6) tangent to (..., 4, 4)."""
    w, rho = xi[..., :3], xi[..., 3:]
    a, b, c = _coefficients((w * w).sum(-1)[..., None, None])
    W = hat(w)
    W2 = W @ W
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    return make(eye + a * W + b * W2, ((eye + b * W + c * W2) @ rho[..., None])[..., 0])


def log(T: Tensor) -> Tensor:
    """(..., 4, 4) to (..., 6); inverse of `exp` for rotations below pi."""
    w = log_rotation(T[..., :3, :3])
    a, b, _ = _coefficients((w * w).sum(-1)[..., None, None])
    W = hat(w)
    # The inverse of exp's I + b W + c W^2.
    eye = torch.eye(3, dtype=T.dtype, device=T.device)
    V_inv = eye - W / 2 + _inverse_coefficient(a, b, (w * w).sum(-1)[..., None, None]) * (W @ W)
    return torch.cat([w, (V_inv @ T[..., :3, 3:])[..., 0]], -1)


def log_rotation(R: Tensor) -> Tensor:
    """Rotation vectors (..., 3), rad, of (..., 3, 3), computed with the quaternion: exact up to pi."""
    q = _quaternion(R)
    w, v = q[..., :1], q[..., 1:]
    square = (v * v).sum(-1, keepdim=True)
    small = square < _SMALL**2
    length = torch.where(small, torch.ones_like(square), square).sqrt()
    near_one = torch.where(small, w, torch.ones_like(w))
    series = 2 / near_one * (1 - square / (3 * near_one**2))
    return torch.where(small, series, 2 * torch.atan2(length, w) / length) * v


def inverse_right_jacobian(w: Tensor) -> Tensor:
    """(..., 3, 3) J with log(exp(w) exp(d)) = w + J d to first order in d, for rotation vectors w (..., 3)."""
    square = (w * w).sum(-1)[..., None, None]
    a, b, _ = _coefficients(square)
    W = hat(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + W / 2 + _inverse_coefficient(a, b, square) * (W @ W)


def _coefficients(square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 of x^2."""
    small = square < _SMALL**2
    safe = torch.where(small, torch.ones_like(square), square)
    x = safe.sqrt()
    a = torch.where(small, 1 - square / 6, x.sin() / x)
    b = torch.where(small, 0.5 - square / 24, 2 * (x / 2).sin() ** 2 / safe)
    c = torch.where(small, 1 / 6 - square / 120, (x - x.sin()) / (safe * x))
    return a, b, c


def _inverse_coefficient(a: Tensor, b: Tensor, square: Tensor) -> Tensor:
    """(1 - a / 2b) / x^2: the factor of W^2 in the inverse of a Jacobian of SO(3)."""
    small = square < 1e-4  # 1 - a / 2b cancels earlier than the others: series below 0.01 rad
    safe = torch.where(small, torch.ones_like(square), square)
    return torch.where(small, 1 / 12 + square / 720, (1 - a / (2 * b)) / safe)


def _quaternion(R: Tensor) -> Tensor:
    """Unit quaternions (..., 4) w, x, y, z with w >= 0, from the largest component, whose root is far from zero."""
    r = R.flatten(-2).unbind(-1)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = r
    rows = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, zy - yz, xz - zx, yx - xy], -1),
            torch.stack([zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx], -1),
            torch.stack([xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz], -1),
            torch.stack([yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz], -1),
        ],
        -2,
    )
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None]
    row = rows.gather(-2, best[..., None].expand(*best.shape, 4))[..., 0, :]
    q = row / (2 * row.gather(-1, best).sqrt())
    return torch.where(q[..., :1] < 0, -q, q)
