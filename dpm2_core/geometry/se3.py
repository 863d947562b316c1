# SPDX-License-Identifier: Apache-2.0
"""SE(3) in numpy: tangent vectors are [rotation rad, translation m], and act on the right, T @ exp(xi)."""

from __future__ import annotations

from math import atan2, sin, sqrt, tan
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpm2_core.frame import Array
from dpm2_core.frame import is_rigid as is_rigid
from dpm2_core.geometry.compiled import compiled

_F = TypeVar("_F", bound=np.floating)
_SMALLEST_VARIANCE = 1e-18


def make(R: ArrayLike, t: ArrayLike) -> Array:
    """(..., 3, 3) and (..., 3) to (..., 4, 4)."""
    R, t = np.asarray(R, np.float64), np.asarray(t, np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: Array) -> Array:
    """Inverse of (..., 4, 4) rigid transforms."""
    R_inv = np.swapaxes(T[..., :3, :3], -1, -2)
    return make(R_inv, -(R_inv @ T[..., :3, 3:])[..., 0])


def transform(T: Array, points: NDArray[_F]) -> NDArray[_F]:
    """T (4, 4) applied to the first three columns of (N, 3+) points; further columns and the dtype are kept."""
    out = points.copy()
    out[:, :3] = points[:, :3] @ T[:3, :3].T.astype(points.dtype) + T[:3, 3].astype(points.dtype)
    return out


def hat(w: ArrayLike) -> Array:
    """(..., 3) to the (..., 3, 3) cross-product matrix."""
    w = np.asarray(w, np.float64)
    out = np.zeros((*w.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return out - np.swapaxes(out, -1, -2)


def exp(xi: ArrayLike) -> Array:
    """(..., 6) tangent to (..., 4, 4)."""
    xi = np.ascontiguousarray(xi, np.float64)
    T = np.empty((*xi.shape[:-1], 4, 4))
    _exp(xi.reshape(-1, 6), T.reshape(-1, 4, 4))
    return T


def log(T: Array) -> Array:
    """(..., 4, 4) to (..., 6); inverse of `exp` for rotations below pi."""
    T = np.ascontiguousarray(T, np.float64)
    xi = np.empty((*T.shape[:-2], 6))
    _log(T.reshape(-1, 4, 4), xi.reshape(-1, 6))
    return xi


def interpolated(T0: Array, T1: Array, part: ArrayLike) -> Array:
    """(..., 4, 4) poses at a fraction `part`, 0 to 1, of the screw motion from T0 to T1 (..., 4, 4)."""
    return T0 @ exp(np.asarray(part)[..., None] * log(inverse(T0) @ T1))


def rotation(w: Array) -> Array:
    """Rotation vectors (..., 3), rad, to (..., 3, 3)."""
    return exp(np.concatenate([w, np.zeros_like(w)], -1))[..., :3, :3]


def rotation_vector(R: Array) -> Array:
    """(..., 3, 3) to (..., 3), rad, up to pi."""
    return log(make(R, np.zeros(3)))[..., :3]


def quaternion(T: Array) -> Array:
    """The rotation of (..., 4, 4) as (..., 4) x, y, z, w with w >= 0."""
    w = log(T)[..., :3]
    half = np.linalg.norm(w, axis=-1, keepdims=True) / 2
    return np.concatenate([w * np.sinc(half / np.pi) / 2, np.abs(np.cos(half))], -1)  # at pi cos may be -1e-16


@compiled("void(f8[:, ::1], f8[:, :, ::1])")
def _exp(xi: Array, T: Array) -> None:
    """`exp` of (N, 6), into (N, 4, 4): Rodrigues' formula with half the angle, to avoid cancellation in 1 - cos."""
    for n in range(len(xi)):
        x, y, z = xi[n, 0], xi[n, 1], xi[n, 2]
        squared = x * x + y * y + z * z
        angle = sqrt(squared)
        if squared < 1e-8:  # where angle - sin cancels
            first, second, third = 1 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
        else:
            first, third = sin(angle) / angle, (angle - sin(angle)) / (squared * angle)
            second = 2 * (sin(angle / 2) / angle) ** 2
        # W is the cross-product matrix of x, y, z; W W is w w^T - squared I.
        W = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
        w, rho = (x, y, z), xi[n, 3:]
        for a in range(3):
            T[n, a, 3] = T[n, 3, a] = 0.0
            for b in range(3):
                delta = 1.0 if a == b else 0.0
                W_squared = w[a] * w[b] - squared * delta
                T[n, a, b] = delta + first * W[a][b] + second * W_squared
                T[n, a, 3] += (delta + second * W[a][b] + third * W_squared) * rho[b]
        T[n, 3, 3] = 1.0


@compiled("void(f8[:, :, ::1], f8[:, ::1])")
def _log(T: Array, xi: Array) -> None:
    """`log` of (N, 4, 4), into (N, 6): with the quaternion, from its largest component (Shepperd 1978)."""
    for n in range(len(T)):
        R = T[n]
        trace = R[0, 0] + R[1, 1] + R[2, 2]
        a = 0 if R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2] else (1 if R[1, 1] >= R[2, 2] else 2)
        b, c = (a + 1) % 3, (a + 2) % 3
        q = xi[n]  # the imaginary parts first
        if trace > R[a, a]:
            real = 1 + trace
            q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        else:
            real = R[c, b] - R[b, c]
            q[a], q[b], q[c] = 1 + R[a, a] - R[b, b] - R[c, c], R[b, a] + R[a, b], R[c, a] + R[a, c]
        length = sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
        angle = 2 * atan2(length, abs(real))
        scale = (angle / length if length > 0 else 0.0) * (-1.0 if real < 0 else 1.0)
        x, y, z = q[0] * scale, q[1] * scale, q[2] * scale
        squared = x * x + y * y + z * z
        # Apply the inverse of the matrix of the translation in `_exp`: 1 - W / 2 + third W W.
        third = 1 / 12 + squared / 720 if squared < 1e-4 else (1 - angle / 2 / tan(angle / 2)) / squared
        u, v, w = T[n, 0, 3], T[n, 1, 3], T[n, 2, 3]
        along = x * u + y * v + z * w
        xi[n, 0], xi[n, 1], xi[n, 2] = x, y, z
        xi[n, 3] = u - (y * w - z * v) / 2 + third * (x * along - squared * u)
        xi[n, 4] = v - (z * u - x * w) / 2 + third * (y * along - squared * v)
        xi[n, 5] = w - (x * v - y * u) / 2 + third * (z * along - squared * w)


def adjoint(T: Array) -> Array:
    """(..., 6, 6) with T @ exp(xi) = exp(adjoint(T) @ xi) @ T."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(t) @ R
    return out


def angle(T: Array) -> Array:
    """Rotation angle of (..., 4, 4), rad; exact near zero, unlike the trace formula."""
    return np.linalg.norm(log(T)[..., :3], axis=-1)


def magnitude(T: Array) -> tuple[float, float]:
    """Translation, m, and rotation angle, degrees, of (4, 4)."""
    return float(np.linalg.norm(T[:3, 3])), float(np.degrees(angle(T)))


def apart(T: Array, T_other: Array) -> tuple[float, float]:
    """Distance, m, and rotation angle, degrees, between two poses (4, 4)."""
    return magnitude(inverse(T) @ T_other)


def way(T: Array, T_other: Array) -> Array:
    """(..., 6) tangent from one pose (..., 4, 4) to another: T @ exp(xi) = T_other."""
    return log(inverse(T) @ T_other)


def squared_sigmas(T: Array, T_other: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of two poses (4, 4); the covariance (6, 6) acts on the right of the first."""
    xi = way(T, T_other)
    return float(xi @ np.linalg.solve(covariance, xi))


def orthonormalized(T: Array) -> Array:
    """The nearest rigid transform (projects the rotation, never to a reflection)."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U[..., -1] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return make(U @ Vt, T[..., :3, 3])


def from_rows(rows: ArrayLike) -> Array:
    """(..., 12) numbers from a file, row-major, to (..., 4, 4), with orthonormal rotation despite rounding."""
    rows = np.asarray(rows, np.float64)
    matrices = rows.reshape(*rows.shape[:-1], 3, 4)
    return orthonormalized(make(matrices[..., :3], matrices[..., 3]))


def is_covariance(covariance: Array, largest: float = 1e15) -> bool:
    """Whether (N, N) is finite, symmetric and positive definite, with variances that a solver can invert."""
    if covariance.ndim != 2 or not np.isfinite(covariance).all():
        return False
    variances = np.diag(covariance)
    if variances.min() < _SMALLEST_VARIANCE or variances.max() > largest:
        return False
    sigma = np.sqrt(variances)
    correlation = covariance / np.outer(sigma, sigma)  # makes rad and m comparable
    if np.abs(correlation - correlation.T).max() > 1e-6:
        return False
    try:
        np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return False
    return True
