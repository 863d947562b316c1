# SPDX-License-Identifier: Apache-2.0
"""Intensity where the geometry is silent: how far along a tunnel or a highway, without a camera.

As by an image (`texture`), one number is unknown, the way along the open direction. What a scan shows is laid out
around that direction, as a tunnel that is cut open and unrolled. The way is the one at which the intensities of a scan
correlate best with those of the scans before.

Two things look as if nothing moved: each beam has a gain of its own, and what does not change along the way, such as
the edge of a road, is always beside the sensor. So an intensity counts relative to its neighbors in the beam, and less
what the scans before had in that direction of the sensor.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from dpm2_core.estimates import Registration
from dpm2_core.frame import NO_POINTS, Array, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.registration.texture import Peak, moved_along, peak

Float = NDArray[np.float32]

_SCANS, _SPACING = 5, 0.5  # that are remembered, and the way between them, m
_PATIENCE = 5  # scans without a known way, after which nothing holds those before to the next one
_RING = np.radians(0.2)  # beams are farther apart
_NEIGHBORS = 25  # in the beam, to either side
_NOISE = 0.03  # standard deviation of an intensity
_CELL = 0.1  # m along the way
_ROWS, _COLUMNS = 180, 600  # cells around, and along
_NEAR, _FAR = 1.0, 30.0  # m away from the axis
_LOCAL = 45  # cells along the way, to either side: what changes more slowly is no texture
_KNOWN = 4  # of these, at least
_LEAST_SPREAD = 0.1  # standard deviations: less is noise
_LIMIT = 3.0  # standard deviations: a reflector is not everything
_SHARED = 300  # cells, at least
_SEARCHED = 150  # cells to either side: what correlates at random
_APART = 6  # cells: another place, not the slope of the best one
_CLEAR, _DISTINCT = 5.0, 2.5
"""The best place correlates better than at random, and than any other one, by so many standard deviations of what is at
random. In 460 scans without texture they were 4.4 and 2.0 at most, within 6 m."""
_ALONE, _MOST_ALONE = 0.5, 3.0
"""By one scan alone it does so by so much more per meter that is looked to a side, and at most. Of vehicles on a road
without texture, each of which is found at its own speed, it was 0.9 more than `_CLEAR` within 6 m."""
_OWN = 0.5  # of what each cell says it says alone: by the errors of 300 scans of KITTI 00 and 04


class IntensitySearch:
    """The way along an open direction, from the last scans to another one."""

    def __init__(self) -> None:
        self._scans: deque[_Placed] = deque(maxlen=_SCANS)
        self._missed = 0  # scans since the way was known
        self._searched = _Scan(NO_POINTS)  # the last one: it is often the next to be remembered

    def update(self, points: Points, T_odom_lidar: Array, tied: bool = True) -> None:
        """A scan (P, 4) that is now at a pose (4, 4); `tied` if its way from those before is known."""
        self._missed = 0 if tied else self._missed + 1
        if self._scans and self._missed <= (_PATIENCE if self._scans[-1].tied else 0):
            way = np.linalg.norm(self._scans[-1].T_odom_lidar[:3, 3] - T_odom_lidar[:3, 3])
            if not tied or way < _SPACING:
                return
        scan = self._searched if self._searched.points is points else _Scan(points)
        self._scans.append(_Placed(scan, T_odom_lidar, tied))

    def along(self, result: Registration, points: Points, reach: float) -> Registration:
        """A registration of a scan (P, 4), moved along its open direction by `search`, or why it is not.

        Args:
            reach: the farthest that is looked to either side, m.
        """
        found = self.search(points, result.T_target_source, result.open_direction, reach)
        if isinstance(found, str):
            return result.because(found)
        return moved_along(result, found, se3.inverse(self._scans[-1].T_odom_lidar), "intensity")

    def search(self, points: Points, T_odom_lidar: Array, axis: Array, reach: float) -> Peak | str:
        """How far along an axis (3,) of the LiDAR frame a scan (P, 4) is, or why that is not known; "" at a start.

        Args:
            T_odom_lidar: (4, 4), but for the way along the axis. reach: the farthest that is looked to either side, m.
        """
        if len(self._scans) < _SCANS:
            return ""
        by_sensor = _unrolled([one.scan.cells(axis) for one in self._scans], axis)
        tied = 1 + next((i for i, one in enumerate(reversed(self._scans)) if not one.tied), _SCANS - 1)
        T_lidar_odom = se3.inverse(T_odom_lidar)
        known = list(self._scans)[-tied:]
        before = _unrolled([one.scan.cells(axis).moved(T_lidar_odom @ one.T_odom_lidar) for one in known], axis)
        self._searched = _Scan(points)
        seen = _unrolled([self._searched.cells(axis)], axis)
        here = _Unrolled(seen.mean - by_sensor.mean, seen.count)
        clear = _CLEAR + (min(_ALONE * reach, _MOST_ALONE) if tied == 1 else 0)
        found = _best(_correlation(before.texture(), here.texture()), reach, clear)
        way = float(axis @ (T_lidar_odom @ self._scans[-1].T_odom_lidar)[:3, 3])
        if tied == 1 and isinstance(found, Peak) and abs(found.offset - way) < _SPACING:
            return "intensity: it stands still, or looks at what moves along"
        return found


class _Scan:
    """A scan, of which what its intensities show is found when it is first asked for."""

    def __init__(self, points: Points) -> None:
        self.points = points
        self._cells: _Cells | None = None

    def cells(self, axis: Array) -> _Cells:
        """Around an axis (3,) of the LiDAR frame, or one that was asked for before: they are fine, whatever it was."""
        if self._cells is None:
            self._cells = _in_cells(self.points, axis)
        return self._cells


@dataclass(frozen=True, eq=False)
class _Placed:
    """A scan and where it was taken (4, 4); `tied` if the way from the one before is known."""

    scan: _Scan
    T_odom_lidar: Array
    tied: bool


@dataclass(frozen=True, eq=False)
class _Cells:
    """Points (N, 3) of a scan in its LiDAR frame, m, one for each cell that it shows, and their contrast (N,)."""

    points: Float
    contrast: Float

    def moved(self, T: Array) -> _Cells:
        """By a transform (4, 4)."""
        return _Cells(se3.transform(T, self.points), self.contrast)


@dataclass(frozen=True, eq=False)
class _Unrolled:
    """Mean contrast (_ROWS, _COLUMNS) by the angle around an axis and the way along it, and of how many points."""

    mean: Float
    count: Float

    def texture(self) -> _Unrolled:
        """What changes within `_LOCAL` cells along the way, over its spread there; each cell counts once."""
        known = (self.count > 0).astype(np.float32)
        around = np.maximum(_window(known), 1)
        away = (self.mean - _window(self.mean * known) / around) * known
        spread = np.sqrt(np.maximum(_window(away * away) / around, 0))
        known *= around >= _KNOWN
        return _Unrolled(np.clip(away / (spread + _LEAST_SPREAD), -_LIMIT, _LIMIT).astype(np.float32) * known, known)


def _contrast(points: Points) -> Float:
    """(P,) intensity of points (P, 4) relative to its neighbors in the beam, in standard deviations of these."""
    x, y, z, intensity = points.T
    ring = np.rint(np.arctan2(z, np.hypot(x, y)) / np.float32(_RING)).astype(np.int64)
    order = np.argsort((ring << 32) + (np.arctan2(y, x) * np.float32(1e8)).astype(np.int64))
    value, ring = intensity[order].astype(np.float64), ring[order]
    total, squares = (np.concatenate([[0.0], np.cumsum(v)]) for v in (value, value * value))
    i = np.arange(len(value))
    first = np.maximum(np.searchsorted(ring, ring, "left"), i - _NEIGHBORS)
    stop = np.minimum(np.searchsorted(ring, ring, "right"), i + _NEIGHBORS + 1)
    mean = (total[stop] - total[first]) / (stop - first)
    variance = np.maximum((squares[stop] - squares[first]) / (stop - first) - mean * mean, 0)
    out = np.empty(len(value), np.float32)
    out[order] = np.clip((value - mean) / np.sqrt(variance + _NOISE**2), -_LIMIT, _LIMIT)
    return out


def _in_cells(points: Points, axis: Array) -> _Cells:
    """Points (P, 4), one for each cell around and along an axis (3,): the mean of those that are in it."""
    near = points[(points[:, :3] ** 2).sum(1) < (_COLUMNS * _CELL / 2) ** 2]
    cell, kept = _cell(near[:, :3], axis)
    count = np.bincount(cell, minlength=_ROWS * _COLUMNS)
    used = np.flatnonzero(count)
    columns = [*near[kept, :3].T, _contrast(near)[kept]]
    means = np.stack([np.bincount(cell, column)[used] / count[used] for column in columns], 1).astype(np.float32)
    return _Cells(means[:, :3], means[:, 3])


def _cell(points: Float, axis: Array) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Number of the cell around and along an axis (3,) of those of the points (N, 3) that are in one, and which."""
    across = np.linalg.svd(axis[None])[2][1:].astype(np.float32)
    along, (y, z) = points @ axis.astype(np.float32), across @ points.T
    column = np.floor(along / np.float32(_CELL)).astype(np.int64) + _COLUMNS // 2
    away = y * y + z * z
    kept = np.flatnonzero((column >= 0) & (column < _COLUMNS) & (away > _NEAR**2) & (away < _FAR**2))
    row = ((np.arctan2(z[kept], y[kept]) + np.float32(np.pi)) * np.float32(_ROWS / (2 * np.pi))).astype(np.int64)
    return row % _ROWS * _COLUMNS + column[kept], kept


def _unrolled(scans: list[_Cells], axis: Array) -> _Unrolled:
    points, values = np.concatenate([one.points for one in scans]), np.concatenate([one.contrast for one in scans])
    cell, kept = _cell(points, axis)
    count = np.bincount(cell, minlength=_ROWS * _COLUMNS)
    mean = np.bincount(cell, values[kept], minlength=_ROWS * _COLUMNS) / np.maximum(count, 1)
    return _Unrolled(*(np.asarray(x, np.float32).reshape(_ROWS, _COLUMNS) for x in (mean, count)))


def _window(values: NDArray[np.floating[Any]]) -> Float:
    """Sums over `_LOCAL` cells to either side."""
    width = 2 * _LOCAL + 1
    return np.asarray(
        cv2.boxFilter(values, -1, (width, 1), normalize=False, borderType=cv2.BORDER_CONSTANT), np.float32
    )


def _correlation(a: _Unrolled, b: _Unrolled) -> Array:
    """Correlation (2 `_SEARCHED` + 1,) of a with b moved along by up to `_SEARCHED` cells, NaN where few are shared."""
    n = scipy.fft.next_fast_len(_COLUMNS + _SEARCHED, real=True)
    (count_a, sum_a, squares_a), (count_b, sum_b, squares_b) = (
        [scipy.fft.rfft(x, n, axis=1) for x in (one.count, one.mean, one.mean**2)] for one in (a, b)
    )

    def summed(x: NDArray[np.complexfloating], y: NDArray[np.complexfloating]) -> Array:
        every = scipy.fft.irfft(np.einsum("ij,ij->j", x, y.conj()), n).astype(np.float64)
        return np.concatenate([every[-_SEARCHED:], every[: _SEARCHED + 1]])

    shared = summed(count_a, count_b)
    count = np.maximum(shared, 1)
    mean_a, mean_b = summed(sum_a, count_b) / count, summed(count_a, sum_b) / count
    var_a, var_b = summed(squares_a, count_b) / count - mean_a**2, summed(count_a, squares_b) / count - mean_b**2
    covariance = summed(sum_a, sum_b) / count - mean_a * mean_b
    return np.where(shared < _SHARED, np.nan, covariance / np.sqrt(np.maximum(var_a * var_b, 1e-6)))


def _best(correlation: Array, reach: float, clear: float) -> Peak | str:
    offset = np.arange(-_SEARCHED, _SEARCHED + 1)
    known = np.isfinite(correlation)
    within = known & (np.abs(offset) * _CELL <= reach)
    if known.sum() < _SEARCHED or not within.any():
        return "intensity: too little is seen again"
    best = int(np.where(within, correlation, -1).argmax())
    others = known & (np.abs(offset - offset[best]) > _APART)
    random = 1.4826 * float(np.median(np.abs(correlation[others] - np.median(correlation[others]))))
    top, second = float(correlation[best]), float(np.max(correlation[others & within], initial=0.0))
    around = slice(max(best - 1, 0), best + 2)
    if (
        not random or top <= clear * random or not top >= correlation[around].max()
    ):  # the latter beside a place beyond reach
        return "intensity: no place stands out"
    if top - second < _DISTINCT * random:
        return "intensity: several places are alike"
    return peak(offset[around] * _CELL, correlation[around], _OWN * random**-2)
