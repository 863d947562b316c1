# SPDX-License-Identifier: Apache-2.0
"""Properties of a spinning LiDAR, estimated from the points of its scans, real or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Array

RANGES = (5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 75.0)
"""Edges of the bins of distance, m."""
_MAX_START_AZIMUTH = 0.02  # rad, largest azimuth offset from 0 at which a ring may begin
_CELL_SIZE = 1.5  # m, of ground that is taken as a plane
_MAX_RANGE_STEP = 0.05  # of the range: largest difference of neighbors on one surface


def rings_of(points: NDArray[np.float32]) -> NDArray[np.intp]:
    """(N,) ring of each point of a scan that is stored ring by ring, each from azimuth 0 up to 2 pi."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    wrapped = np.diff(np.where(azimuth < -_MAX_START_AZIMUTH, azimuth + 2 * np.pi, azimuth)) < -np.pi
    return np.concatenate([[0], np.cumsum(wrapped)])


def statistics(scans: Sequence[NDArray[np.float32]]) -> dict[str, Any]:
    """Figures of the scans (N, 4) of one sensor; lists are by the bins of `RANGES`, None if there are too few points.

    ring_gap_deg: median and standard deviation of the gaps between rings, upper half and lower half. upper_origin_m:
    height of the origin of the upper beams above the sensor's origin; close returns then appear higher. wobble_deg:
    remaining standard deviation of the elevation within an upper ring. ring_range_noise_m: of a single return relative
    to its neighbors on the same ring. plane_rms_m: distance of ground points from the plane of their cell.
    ring_bias_m: standard deviation between rings of their mean distance to those planes. lost: fraction of pulses
    without return between two returns from one surface. intensity: quantiles 10, 50, 90 %, and the fraction of zeros.
    """
    elevations, upper = [], []
    noise: list[list[Array]] = [[] for _ in RANGES[1:]]
    lost = np.zeros((2, len(RANGES) - 1))
    planes: list[Array] = []
    for scan in scans:
        ring, distance = rings_of(scan), np.linalg.norm(scan[:, :3].astype(float), axis=1)
        elevation = np.degrees(np.arcsin(scan[:, 2] / np.maximum(distance, 1e-6)))
        rows = [elevation[ring == k] for k in range(ring.max() + 1)]
        elevations.append([np.median(row) for row in rows])
        half = ring < len(rows) // 2
        upper.append(np.stack([ring[half], 1 / distance[half], elevation[half]]))
        bins = np.digitize(distance, RANGES) - 1
        for k, values in _ring_noise(ring, distance, bins):
            noise[k].append(values)
        lost += _lost(scan, ring, distance, bins)
        planes.append(_plane_residuals(scan, ring))
    rings = min(len(row) for row in elevations)
    gaps = -np.diff(np.median([row[:rings] for row in elevations], 0))
    residual = np.concatenate(planes)
    intensity = np.concatenate([scan[:, 3] for scan in scans])
    origin, wobble = _origin(np.concatenate(upper, 1))
    halves = np.split(gaps, [len(gaps) // 2])
    return {
        "scans": len(scans),
        "points": float(np.mean([len(scan) for scan in scans])),
        "ring_gap_deg": [[float(np.median(half)), float(half.std())] for half in halves],
        "elevations_deg": np.median([row[:rings] for row in elevations], 0).round(3).tolist(),
        "upper_origin_m": float(np.radians(origin)),
        "wobble_deg": wobble,
        "ring_range_noise_m": [_deviation(np.concatenate(part)) if part else None for part in noise],
        "plane_rms_m": [_rms(residual[residual[:, 0] == k, 2]) for k in range(len(RANGES) - 1)],
        "ring_bias_m": _ring_bias(residual),
        "lost": [float(a / b) if b > 1000 else None for a, b in lost.T],
        "intensity": {
            "quantiles": [float(v) for v in np.quantile(intensity[intensity > 0], (0.1, 0.5, 0.9))],
            "zeros": float((intensity == 0).mean()),
            "histogram": (np.histogram(intensity, np.linspace(0, 1, 21))[0] / len(intensity)).round(4).tolist(),
        },
    }


def _origin(upper: Array) -> tuple[float, float]:
    """Slope of elevation, deg, over 1 / distance within rings, and the standard deviation of the residuals, deg.

    upper: (3, N) ring, 1 / distance, elevation.
    """
    ring = upper[0].astype(int)
    count = np.maximum(np.bincount(ring), 1)
    inverse, elevation = (row - (np.bincount(ring, row) / count)[ring] for row in upper[1:])
    slope = float((inverse * elevation).sum() / (inverse**2).sum())
    return slope, float((elevation - slope * inverse).std())


def _ring_noise(ring: NDArray[np.intp], distance: Array, bins: NDArray[np.intp]) -> list[tuple[int, Array]]:
    """Second differences of ranges along rings, scaled to one return's standard deviation, by bins of distance."""
    a, b, c = distance[:-2], distance[1:-1], distance[2:]
    same_surface = (
        (ring[:-2] == ring[2:]) & (np.abs(a - c) < _MAX_RANGE_STEP * b) & (np.abs(a + c - 2 * b) < _MAX_RANGE_STEP * b)
    )
    second = (a + c - 2 * b)[same_surface] / np.sqrt(6)
    bin_of = bins[1:-1][same_surface]
    return [(k, second[bin_of == k]) for k in range(len(RANGES) - 1)]


def _lost(scan: NDArray[np.float32], ring: NDArray[np.intp], distance: Array, bins: NDArray[np.intp]) -> Array:
    """(2, bins) missing pulses between neighbors on one surface, and total number of pulses there."""
    azimuth = np.unwrap(np.arctan2(scan[:, 1], scan[:, 0]).astype(float))
    gap = np.diff(azimuth)
    step = np.median(gap[(ring[1:] == ring[:-1]) & (gap > 0)])
    steps = np.rint(gap / step)
    near = (
        (ring[1:] == ring[:-1])
        & (np.abs(np.diff(distance)) < _MAX_RANGE_STEP * distance[1:])
        & (steps >= 1)
        & (steps <= 8)
    )
    out = np.zeros((2, len(RANGES) - 1))
    for k in range(len(RANGES) - 1):
        chosen = steps[near & (bins[1:] == k)]
        out[:, k] = (chosen - 1).sum(), chosen.sum()
    return out


def _plane_residuals(scan: NDArray[np.float32], ring: NDArray[np.intp]) -> Array:
    """(M, 3) bin of distance, ring and signed distance, m, to the plane of the cell, for points on flat ground."""
    low = (scan[:, 2] < -0.8) & (np.hypot(scan[:, 0], scan[:, 1]) < RANGES[-1])
    points, rings = scan[low, :3].astype(float), ring[low]
    _, cell, count = np.unique(np.floor(points[:, :2] / _CELL_SIZE), axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()
    mean = np.stack([np.bincount(cell, points[:, k]) for k in range(3)], -1) / count[:, None]
    centered = points - mean[cell]
    outer = np.zeros((len(count), 3, 3))
    np.add.at(outer, cell, centered[:, :, None] * centered[:, None])
    values, vectors = np.linalg.eigh(outer / count[:, None, None])
    is_flat = (count >= 30) & (np.abs(vectors[:, 2, 0]) > 0.98) & (values[:, 0] < 0.06**2) & (values[:, 1] > 0.25**2)
    normal = vectors[:, :, 0] * np.sign(vectors[:, 2:, 0])
    chosen = is_flat[cell]
    distance = np.einsum("ij,ij->i", centered[chosen], normal[cell[chosen]])
    bins = np.digitize(np.linalg.norm(points[chosen], axis=1), RANGES) - 1
    return np.stack([bins, rings[chosen], distance], -1)


def _ring_bias(residual: Array) -> float | None:
    """Standard deviation between rings of their mean residual, for rings with at least 300 points."""
    ring = residual[:, 1].astype(int)
    count = np.bincount(ring)
    mean = np.bincount(ring, residual[:, 2])[count >= 300] / count[count >= 300]
    return float(mean.std()) if len(mean) > 3 else None


def _deviation(values: Array) -> float | None:
    """Standard deviation from the median absolute deviation: outliers at edges of objects do not count."""
    return float(1.4826 * np.median(np.abs(values))) if len(values) > 500 else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt((values**2).mean())) if len(values) > 500 else None
