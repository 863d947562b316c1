# SPDX-License-Identifier: Apache-2.0
"""The precision-weighted solve: with gradients, and compiled for inference, with the same steps but no gradients."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpm2_core.frame import Array
from dpm2_core.geometry.compiled import compiled
from dpm2_core.geometry.se3_torch import exp, hat
from dpm2_core.network.matching import Correspondences

ROUNDS = 8  # steps
SOFT = 3.0  # squared residual from which the weights fall
_DAMPING = 1e-6


def whitened_residuals(T: Tensor, pairs: Correspondences) -> tuple[Tensor, Tensor]:
    """Residuals in units of their standard deviation (B, 2K, 3) and their Jacobian (B, 2K, 3, 6) for T exp(xi)."""
    half = pairs.source.shape[1] // 2
    R, t = T[:, None, :3, :3], T[:, None, :3, 3]
    source, target, L = pairs.source.double(), pairs.target.double(), pairs.L.double()
    moved_back = ((target - t)[..., None, :] @ R)[..., 0, :]  # R^T (y - t)
    L = torch.cat([L[:, :half], R.transpose(-1, -2) @ L[:, half:]], 1)  # all in the source frame
    # In the source frame the step rotates the target's point, in the target frame the source's.
    lever_arm = torch.cat([moved_back[:, :half], source[:, half:]], 1)
    minus_hat = hat(-lever_arm)
    eye = torch.eye(3, dtype=source.dtype, device=source.device).expand_as(minus_hat)
    jacobian = L.transpose(-1, -2) @ torch.cat([minus_hat, eye], -1)
    residual = (L.transpose(-1, -2) @ (source - moved_back)[..., None])[..., 0]
    return residual, jacobian


def weighted_gauss_newton(T: Tensor, pairs: Correspondences, rounds: int = ROUNDS) -> tuple[Tensor, Tensor]:
    """Iteratively reweighted Gauss-Newton on the residuals, weighted with their predicted precision.

    The weights are those of Geman and McClure. In a tunnel all points of a scan, each with a low precision, indicate
    that nothing moved. A few image corners that contradict them still prevail if the steps start at their solution.

    Args:
        T: (B, 4, 4) start. pairs: the correspondences.

    Returns:
        T (B, 4, 4) and the information matrix (B, 6, 6) of xi in T exp(xi), rotation first.
    """
    information = T.new_zeros(len(T), 6, 6)
    damping = torch.eye(6, dtype=T.dtype, device=T.device) * _DAMPING
    for _ in range(rounds):
        residual, jacobian = whitened_residuals(T, pairs)
        squared = (residual * residual).sum(-1)
        weight = pairs.weight * ((SOFT + 3) / (SOFT + squared)) ** 2
        weighted = jacobian * weight[..., None, None]
        information = (weighted.flatten(1, 2).transpose(1, 2) @ jacobian.flatten(1, 2)) + damping
        gradient = weighted.flatten(1, 2).transpose(1, 2) @ residual.flatten(1, 2)[..., None]
        T = T @ exp(-torch.linalg.solve(information, gradient)[..., 0])
    return T, information


@compiled("void(f8[:, ::1], f8[::1], f8[::1])")
def _solve(A: Array, b: Array, x: Array) -> None:
    """x (6,) with A x = b, A (6, 6) symmetric and positive definite, by Cholesky; NaN if A is not."""
    L = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(s) if i == j else s / L[j, j]
    for i in range(6):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@compiled("void(f8[:, ::1], f8[::1])")
def _move(T: Array, xi: Array) -> None:
    """T (4, 4) becomes T exp(xi), xi (6,) [rotation, translation]."""
    square = xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2]
    angle = np.sqrt(square)
    if square < 1e-8:  # the series' next terms are below the rounding
        a, b, c = 1 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120
    else:
        a, b, c = np.sin(angle) / angle, (1 - np.cos(angle)) / square, (angle - np.sin(angle)) / (square * angle)
    W, E, V = np.zeros((3, 3)), np.eye(3), np.eye(3)
    W[0, 1], W[0, 2], W[1, 2] = -xi[2], xi[1], -xi[0]
    W[1, 0], W[2, 0], W[2, 1] = xi[2], -xi[1], xi[0]
    for i in range(3):
        for j in range(3):
            W2 = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            E[i, j] += a * W[i, j] + b * W2
            V[i, j] += b * W[i, j] + c * W2
    for i in range(3):
        x, y, z = T[i, 0], T[i, 1], T[i, 2]
        for j in range(3):
            T[i, j] = x * E[0, j] + y * E[1, j] + z * E[2, j]
            T[i, 3] += (x * V[0, j] + y * V[1, j] + z * V[2, j]) * xi[3 + j]


@compiled("void(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1])")
def _whiten(T: Array, source: Array, target: Array, L: Array, residual: Array, jacobian: Array) -> None:
    """Residuals (N, 3) in units of their standard deviation and their Jacobian (N, 3, 6). The precision L L^T of the
    first half of the pairs is in the source frame, that of the other half in the target frame."""
    half, arm, back, P = len(source) // 2, np.empty(3), np.empty(3), np.empty((3, 3))
    for n in range(len(source)):
        x, y, z = target[n, 0] - T[0, 3], target[n, 1] - T[1, 3], target[n, 2] - T[2, 3]
        for i in range(3):
            back[i] = T[0, i] * x + T[1, i] * y + T[2, i] * z
            arm[i] = back[i] if n < half else source[n, i]
            for j in range(3):
                if n < half:
                    P[i, j] = L[n, i, j]
                else:
                    P[i, j] = T[0, i] * L[n, 0, j] + T[1, i] * L[n, 1, j] + T[2, i] * L[n, 2, j]
        for j in range(3):
            p, q, r = P[0, j], P[1, j], P[2, j]
            residual[n, j] = p * (source[n, 0] - back[0]) + q * (source[n, 1] - back[1]) + r * (source[n, 2] - back[2])
            jacobian[n, j, 0] = r * arm[1] - q * arm[2]
            jacobian[n, j, 1] = p * arm[2] - r * arm[0]
            jacobian[n, j, 2] = q * arm[0] - p * arm[1]
            jacobian[n, j, 3], jacobian[n, j, 4], jacobian[n, j, 5] = p, q, r


@compiled("Tuple((f8[:, ::1], f8[::1]))(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1])")
def solve_pose(T: Array, source: Array, target: Array, weight: Array, L: Array) -> tuple[Array, Array]:
    """`weighted_gauss_newton` of one set of pairs.

    Args:
        T: (4, 4) start; it becomes the result. source, target: (N, 3), m; weight: (N,); L: (N, 3, 3): see
            `Correspondences`.

    Returns:
        Information matrix (6, 6) of xi in T exp(xi) at the last step, and the squared residuals (N,) after it.
    """
    n_pairs = len(source)
    residual, jacobian, squared = np.empty((n_pairs, 3)), np.empty((n_pairs, 3, 6)), np.empty(n_pairs)
    information, gradient, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for _ in range(ROUNDS):
        _whiten(T, source, target, L, residual, jacobian)
        for i in range(6):
            for j in range(6):
                information[i, j] = _DAMPING if i == j else 0.0
            gradient[i] = 0.0
        for n in range(n_pairs):
            s = residual[n, 0] ** 2 + residual[n, 1] ** 2 + residual[n, 2] ** 2
            w = weight[n] * ((SOFT + 3) / (SOFT + s)) ** 2
            for axis in range(3):
                for i in range(6):
                    weighted = w * jacobian[n, axis, i]
                    gradient[i] -= weighted * residual[n, axis]
                    for j in range(6):
                        information[i, j] += weighted * jacobian[n, axis, j]
        _solve(information, gradient, step)
        _move(T, step)
    _whiten(T, source, target, L, residual, jacobian)
    for n in range(n_pairs):
        squared[n] = residual[n, 0] ** 2 + residual[n, 1] ** 2 + residual[n, 2] ** 2
    return information, squared
