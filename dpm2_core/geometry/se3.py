# SPDX-License-Identifier: Apache-2.0
"""SE(3) in numpy: tangent vectors are [rotation rad, translation m], and act on the right, T @ exp(xi)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from dpm2_core.frame import is_rigid as is_rigid

Array = NDArray[np.float64]

_F = TypeVar("_F", bound=np.floating)


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
    """T (4, 4) applied to the first three columns of (N, 3+) points; further columns and the dtype stay."""
    out = points.copy()
    out[:, :3] = points[:, :3] @ T[:3, :3].T.astype(points.dtype) + T[:3, 3].astype(points.dtype)
    return out


def hat(w: ArrayLike) -> Array:
    """(..., 3) to the (..., 3, 3) cross-product matrix."""
    w = np.asarray(w, np.float64)
    out = np.zeros((*w.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return out - np.swapaxes(out, -1, -2)


def _left_jacobian(w: Array) -> Array:
    """V with translation = V @ rho, for (..., 3) rotation vectors; series below 1e-4 rad, where 1 - cos cancels."""
    theta2 = (w * w).sum(-1)[..., None, None]
    small = theta2 < 1e-8
    safe = np.where(small, 1.0, theta2)
    theta = np.sqrt(safe)
    a = np.where(small, 0.5 - theta2 / 24, (1 - np.cos(theta)) / safe)
    b = np.where(small, 1 / 6 - theta2 / 120, (theta - np.sin(theta)) / (safe * theta))
    W = hat(w)
    return np.eye(3) + a * W + b * (W @ W)


def exp(xi: ArrayLike) -> Array:
    """(..., 6) tangent to (..., 4, 4)."""
    xi = np.asarray(xi, np.float64)
    w, rho = xi[..., :3], xi[..., 3:]
    return make(rotation(w), (_left_jacobian(w) @ rho[..., None])[..., 0])


def log(T: Array) -> Array:
    """(..., 4, 4) to (..., 6); inverse of `exp` for rotations below pi."""
    w = rotation_vector(T[..., :3, :3])
    rho = np.linalg.solve(_left_jacobian(w), T[..., :3, 3:])[..., 0]
    return np.concatenate([w, rho], -1)


def rotation(w: Array) -> Array:
    """Rotation vectors (..., 3), rad, to (..., 3, 3)."""
    return np.asarray(Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape, 3))


def rotation_vector(R: Array) -> Array:
    """(..., 3, 3) to (..., 3), rad, up to pi."""
    return np.asarray(Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-1]))


def adjoint(T: Array) -> Array:
    """(..., 6, 6) with T @ exp(xi) = exp(adjoint(T) @ xi) @ T."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(t) @ R
    return out


def angle(T: Array) -> Array:
    """Rotation angle of (..., 4, 4), rad; exact near zero, where the trace formula is not."""
    return np.linalg.norm(rotation_vector(T[..., :3, :3]), axis=-1)


def magnitude(T: Array) -> tuple[float, float]:
    """How far (4, 4) moves, m, and how far it turns, degrees: of `inverse(a) @ b` the distance of two poses."""
    return float(np.linalg.norm(T[:3, 3])), float(np.degrees(angle(T)))


def orthonormalized(T: Array) -> Array:
    """The nearest rigid transform (projects the rotation, guards against a reflection)."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U[..., -1] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return make(U @ Vt, T[..., :3, 3])


def from_rows(rows: ArrayLike) -> Array:
    """(..., 12) numbers of files, row-major, to (..., 4, 4), their rounding removed."""
    rows = np.asarray(rows, np.float64)
    matrices = rows.reshape(*rows.shape[:-1], 3, 4)
    return orthonormalized(make(matrices[..., :3], matrices[..., 3]))


def quaternion(T: Array) -> Array:
    """Rotation of (4, 4) as the unit quaternion x, y, z, w with w >= 0."""
    q = Rotation.from_matrix(T[:3, :3]).as_quat()
    return q if q[3] >= 0 else -q


def is_covariance(covariance: Array, smallest: float = 1e-18, largest: float = 1e15) -> bool:
    """Whether (N, N) is finite, symmetric, positive definite, with variances that a solver can invert."""
    if covariance.ndim != 2 or not np.isfinite(covariance).all():
        return False
    variances = np.diag(covariance)
    if variances.min() < smallest or variances.max() > largest:
        return False
    sigma = np.sqrt(variances)
    correlation = covariance / np.outer(sigma, sigma)  # so that rad and m, however different, are treated alike
    if np.abs(correlation - correlation.T).max() > 1e-6:
        return False
    try:
        np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return False
    return True
