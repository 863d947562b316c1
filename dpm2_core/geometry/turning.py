# SPDX-License-Identifier: Apache-2.0
"""Integrates the angular rates of a gyroscope to rotations of the sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpm2_core.frame import Array
from dpm2_core.geometry import se3

_MAX_GAP = 0.1  # s between two samples, across which the rate is assumed to change linearly
_MAX_EXTRAPOLATION = 0.05  # s before the first sample or after the last, for which its rate is assumed to continue
_MAX_PERIOD = 0.11  # s between the samples of the slowest IMU: at 10 Hz, as from kitti2bag, it is 0.104 s
_MAX_GAP_PERIODS = 1.25  # largest gap between samples of a slow IMU, in usual periods


def turned(seconds: NDArray[np.floating], rates: Array, at: ArrayLike) -> Array | None:
    """Rotations R_0_t (M, 3, 3) from the axes at the times `at` (M,) s to those at 0 s.

    Between two samples the rate is interpolated linearly; the error falls with the square of their distance.

    Args:
        seconds: (K,) increasing times of the samples. rates: (K, 3) rad/s about the sensor's own axes.

    Returns:
        None if samples are missing: more than 0.1 s between two of them, or more than 0.05 s from the times to the
        nearest; for an IMU of 10 Hz a quarter more than its period.
    """
    at = np.asarray(at, np.float64)
    low, high = min(0.0, float(at.min())), max(0.0, float(at.max()))
    max_gap, max_extrapolation = _limits(seconds)
    near = (seconds > low - max_gap) & (seconds < high + max_gap)
    seconds, rates = seconds[near], rates[near]
    if len(seconds) > 1 and seconds[1] <= low:  # of the samples before, only the last one is needed
        first = int(np.searchsorted(seconds, low, "right")) - 1
        seconds, rates = seconds[first:], rates[first:]
    if len(seconds) > 1 and seconds[0] < low and seconds[1] - seconds[0] > max_gap:
        seconds, rates = seconds[1:], rates[1:]  # the IMU paused before `low`
    last = int(np.searchsorted(seconds, high)) + 1
    seconds, rates = seconds[:last], rates[:last]
    if len(seconds) > 1 and seconds[-1] > high and seconds[-1] - seconds[-2] > max_gap:
        seconds, rates = seconds[:-1], rates[:-1]
    if not len(seconds) or seconds[0] > low + max_extrapolation or seconds[-1] < high - max_extrapolation:
        return None
    if len(seconds) > 1 and np.diff(seconds).max() > max_gap:
        return None
    before, after = min(low, float(seconds[0])), max(high, float(seconds[-1]))
    seconds = np.concatenate([[before - 1e-9], seconds, [after + 1e-9]])
    rates = np.concatenate([rates[:1], rates, rates[-1:]])
    steps = np.diff(seconds)
    step_rotations = se3.rotation((rates[1:] + rates[:-1]) / 2 * steps[:, None])
    nodes = np.empty((len(seconds), 3, 3))
    nodes[0] = np.eye(3)
    for k, R in enumerate(step_rotations):
        nodes[k + 1] = nodes[k] @ R

    def rotation(times: Array) -> Array:
        k = np.clip(np.searchsorted(seconds, times, "right") - 1, 0, len(steps) - 1)
        since = (times - seconds[k])[:, None]
        mean = rates[k] + (rates[k + 1] - rates[k]) * since / (2 * np.maximum(steps[k], 1e-9)[:, None])
        return nodes[k] @ se3.rotation(mean * since)

    return np.asarray(rotation(np.zeros(1))[0].T @ rotation(at))


def _limits(seconds: NDArray[np.floating]) -> tuple[float, float]:
    """Largest s between two samples, and beyond the first and last one, from the usual distance of the samples (K,)."""
    usual = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    allowed = _MAX_GAP_PERIODS * usual if usual < _MAX_PERIOD else 0.0
    return max(_MAX_GAP, allowed), max(_MAX_EXTRAPOLATION, allowed)


def leveled(up: ArrayLike, axis: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """The smallest rotation (3, 3) that rotates the direction `up` (3,) to `axis` (3,); lengths do not matter."""
    u, z = (np.asarray(v, np.float64) / np.linalg.norm(v) for v in (up, axis))
    cross, cosine = np.cross(u, z), float(u @ z)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        cross = np.cross(u, np.eye(3)[int(np.abs(u).argmin())])  # upside down: about any horizontal axis
        return np.asarray(se3.rotation(np.pi * cross / np.linalg.norm(cross)))
    return np.asarray(se3.rotation(cross / sine * np.arctan2(sine, cosine)))
