# SPDX-License-Identifier: Apache-2.0
"""The inner loops of the point-to-plane registration, of a rigid scan and of a sweep in motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array
from dpm2_core.geometry.compiled import compiled

ORDER = 3
"""Degree of the motion during a sweep as a polynomial in time: a twist, its rate and the rate of that. A legged
robot makes 4 steps per second, nearly half a step in a sweep of 0.1 s: with degree 2 its errors were 2 to 3 times as
large."""


@compiled("Tuple((f8[::1], f8[:, ::1], f8[::1]))(f8[:, ::1], i4[::1], f8[:, ::1], f8[:, ::1], f8[::1])")
def distances(
    queries: Array, index: NDArray[np.int32], points: Array, normals: Array, variances: Array
) -> tuple[Array, Array, Array]:
    """Distances (Q,), m, of queries (Q, 3) from the planes through points[index] (M, 3), and these planes' normals
    (Q, 3) and variances (Q,), m2. All are NaN where the index is negative."""
    residual, variance = np.full(len(queries), np.nan), np.full(len(queries), np.nan)
    normal = np.full((len(queries), 3), np.nan)
    for q in range(len(queries)):
        i = index[q]
        if i < 0:
            continue
        residual[q], variance[q] = 0.0, variances[i]
        for a in range(3):
            normal[q, a] = normals[i, a]
            residual[q] += (queries[q, a] - points[i, a]) * normals[i, a]
    return residual, normal, variance


@compiled("void(f8[::1], f8[:, ::1], f8[::1], f8[::1])")
def _distance_jacobian(point: Array, R: Array, normal: Array, J: Array) -> None:
    """Write the derivative of a point's (3,) distance along a normal (3,) to J (6,), for a step on the right of a pose
    with the rotation R (3, 3)."""
    for i in range(3):
        J[3 + i] = normal[0] * R[0, i] + normal[1] * R[1, i] + normal[2] * R[2, i]
    J[0] = point[1] * J[5] - point[2] * J[4]
    J[1] = point[2] * J[3] - point[0] * J[5]
    J[2] = point[0] * J[4] - point[1] * J[3]


@compiled("Tuple((f8[:, ::1], f8[::1], i8, f8))(f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])")
def linearize(
    source: Array, R: Array, residual: Array, normals: Array, variances: Array
) -> tuple[Array, Array, int, float]:
    """One least-squares step with a Cauchy kernel.

    Args:
        source: (N, 3) points in the sensor frame; R: (3, 3) the rotation of the pose.
        residual: (N,) distances from planes, m, NaN for unmatched points; normals: (N, 3); variances: (N,), m2.

    Returns:
        Hessian (6, 6) and gradient (6,) of a step [rad, m] on the right of the pose; number of residuals within three
        standard deviations, and their root mean square, m.
    """
    H, gradient, J = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    fits, total = 0, 0.0
    for n in range(len(source)):
        if np.isnan(residual[n]):
            continue
        _distance_jacobian(source[n], R, normals[n], J)
        squared = residual[n] * residual[n]
        weight = 1 / (variances[n] + squared)
        for row in range(6):
            gradient[row] += J[row] * weight * residual[n]
            for column in range(row + 1):
                H[row, column] += J[row] * weight * J[column]
        if squared < 9 * variances[n]:
            fits += 1
            total += squared
    for row in range(6):
        for column in range(row):
            H[column, row] = H[row, column]
    return H, gradient, fits, np.sqrt(total / fits) if fits else np.inf


@compiled("Tuple((f8[:, :, ::1], f8[:, ::1]))(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])")
def moments(
    source: Array, times: Array, R: Array, residual: Array, normals: Array, variances: Array
) -> tuple[Array, Array]:
    """As `linearize`, with Hessian and gradient weighted by powers of the times (N,) of the points.

    Returns:
        (2 ORDER + 1, 6, 6) Hessians, the k-th with each point times its time^k, and (ORDER + 1, 6) gradients.
    """
    H, gradient, J = np.zeros((2 * ORDER + 1, 6, 6)), np.zeros((ORDER + 1, 6)), np.empty(6)
    for n in range(len(source)):
        if np.isnan(residual[n]):
            continue
        _distance_jacobian(source[n], R, normals[n], J)
        weight = 1 / (variances[n] + residual[n] * residual[n])
        for k in range(2 * ORDER + 1):
            for row in range(6):
                if k <= ORDER:
                    gradient[k, row] += J[row] * weight * residual[n]
                for column in range(row + 1):
                    H[k, row, column] += J[row] * weight * J[column]
            weight *= times[n]
    for row in range(6):
        for column in range(row):
            H[:, column, row] = H[:, row, column]
    return H, gradient
