# SPDX-License-Identifier: Apache-2.0
"""Least-squares planes for many small neighborhoods at once."""

from __future__ import annotations

from math import acos, cos, pi, sqrt

import numpy as np

from dpm2_core.frame import Array
from dpm2_core.geometry.compiled import compiled


@compiled("Tuple((f8[:, ::1], f8[::1]))(f8[:, :, ::1])")
def fit_planes(neighborhoods: Array) -> tuple[Array, Array]:
    """Unit normals (N, 3) and variances along them (N,), m2, of (N, k, 3) neighborhoods.

    The smallest eigenvector of each covariance in closed form (trigonometric solution of the characteristic cubic).
    A neighborhood without any extent has the normal (0, 0, 1) and the variance 0.
    """
    n, k, _ = neighborhoods.shape
    normals, variances = np.empty((n, 3)), np.empty(n)
    for i in range(n):
        mx = my = mz = 0.0
        for j in range(k):
            mx += neighborhoods[i, j, 0] / k
            my += neighborhoods[i, j, 1] / k
            mz += neighborhoods[i, j, 2] / k
        xx = xy = xz = yy = yz = zz = 0.0
        for j in range(k):
            x, y, z = neighborhoods[i, j, 0] - mx, neighborhoods[i, j, 1] - my, neighborhoods[i, j, 2] - mz
            xx += x * x / k
            xy += x * y / k
            xz += x * z / k
            yy += y * y / k
            yz += y * z / k
            zz += z * z / k
        mean = (xx + yy + zz) / 3
        a, d, f = xx - mean, yy - mean, zz - mean
        spread = sqrt((a * a + d * d + f * f + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
        det = a * (d * f - yz * yz) - xy * (xy * f - yz * xz) + xz * (xy * yz - d * xz)
        cosine = min(max(det / max(2 * spread**3, 1e-300), -1.0), 1.0)
        smallest = mean + 2 * spread * cos((acos(cosine) + 2 * pi) / 3)
        a, d, f = xx - smallest, yy - smallest, zz - smallest
        # The rows of C - smallest * I span the plane: the longest cross product of two of them is the normal.
        crosses = (
            (xy * yz - xz * d, xz * xy - a * yz, a * d - xy * xy),
            (xy * f - xz * yz, xz * xz - a * f, a * yz - xy * xz),
            (d * f - yz * yz, yz * xz - xy * f, xy * yz - d * xz),
        )
        longest = 1e-150
        normals[i] = 0.0, 0.0, 1.0
        for x, y, z in crosses:
            length = sqrt(x * x + y * y + z * z)
            if length > longest:
                longest = length
                normals[i] = x / length, y / length, z / length
        variances[i] = max(smallest, 0.0)
    return normals, variances
