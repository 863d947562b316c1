# SPDX-License-Identifier: Apache-2.0
"""Paths of the streets and the car's motion on them. Plane coordinates in m; arc length `s` in m."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from dpm2_core.data.text import read_numbers
from dpm2_core.data.trajectory import FRAME_PERIOD, arc_lengths
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.sim.floorplan import FloorPlan, car_park, office
from dpm2_core.sim.settings import Preset

ROAD_KINDS = ("straight", "loop", "figure8", "random")
STEP = 0.5
"""Distance between the samples of a path, m."""


class Path:
    """A smooth plane curve, sampled every `STEP` m.

    Attributes:
        xy: (M, 2) m. closed: the end joins the start. length: m. yaw: (M,) unwrapped heading, rad.
    """

    def __init__(self, xy: ArrayLike, closed: bool = False) -> None:
        line = np.asarray(xy, float)
        if closed:
            line = np.concatenate([line, line[:1]])
        line = line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6])]
        s = arc_lengths(line)
        self.closed, self.length = closed, float(s[-1])
        self.s = np.linspace(0, self.length, max(round(self.length / STEP), 2) + 1)
        self.xy = np.stack([np.interp(self.s, s, line[:, k]) for k in (0, 1)], -1)
        ahead = np.gradient(self.xy, axis=0)
        if closed:
            ahead[0] = ahead[-1] = self.xy[1] - self.xy[-2]
        self.yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))

    def at(self, s: ArrayLike, lateral: ArrayLike = 0.0) -> tuple[Array, Array]:
        """Points (N, 2) and headings (N,) at arc lengths (N,), `lateral` m to the left; wraps around a closed path."""
        at = np.atleast_1d(np.asarray(s, float))
        at = np.mod(at, self.length) if self.closed else np.clip(at, 0, self.length)
        yaw = np.interp(at, self.s, self.yaw)
        xy = np.stack([np.interp(at, self.s, self.xy[:, k]) for k in (0, 1)], -1)
        left = np.stack([-np.sin(yaw), np.cos(yaw)], -1)
        return xy + left * np.broadcast_to(np.asarray(lateral, float), at.shape)[:, None], yaw

    def shifted(self, lateral: float) -> Path:
        """The parallel curve `lateral` m to the left, smoothed where it would fold."""
        xy = self.at(self.s, lateral)[0]
        return Path(_smooth(xy[:-1] if self.closed else xy, 2.0, self.closed), self.closed)


@dataclass(eq=False)
class Road:
    """Streets and a drive.

    Attributes:
        streets: center lines; the drive follows the first `main` of them, the others branch off.
        drive: the path of the car. times: (K,) s and travelled: (K,) m, the drive's progress; a closed one continues.
        heights: (M,) m of the samples of each main street; None if they are not given.
        slip: (K,) rad, heading of the car relative to the direction of the drive; None: they are equal.
        plan: of the building that the drive leads through.
    """

    streets: list[Path]
    main: int
    drive: Path
    times: Array
    travelled: Array
    heights: list[Array] | None = None
    slip: Array | None = None
    plan: FloorPlan | None = None

    def slip_at(self, time: float) -> float:
        """Rotation of the car to the left of its direction of motion, rad, at a time, s."""
        return 0.0 if self.slip is None else float(np.interp(time, self.times, self.slip))

    def distance(self, time: ArrayLike) -> Array:
        """Arc length on the drive, m, at times (N,) s."""
        time = np.asarray(time, float)
        if not self.drive.closed:
            return np.interp(time, self.times, self.travelled)
        laps = np.floor(time / self.times[-1])
        return laps * self.drive.length + np.interp(time - laps * self.times[-1], self.times, self.travelled)


def make_road(kind: str, preset: Preset, rng: np.random.Generator, length: float = 400.0) -> Road:
    """A road of about `length` m (a lap, if it is closed) to drive on.

    Args:
        kind: straight, loop, figure8, random, or a file of KITTI poses (camera frame, 12 numbers per line).

    Raises:
        UsageError: no such kind or file, or the file contains no drive.
    """
    if preset.indoor:
        return _indoors(kind, preset, rng, length)
    if kind not in ROAD_KINDS:
        return _road_of_poses(FilePath(kind), preset, rng)
    center = _center_line(kind, preset, rng, length)
    drive = center.shifted(-preset.lane)
    start = 0.0 if center.closed else min(MARGIN, drive.length / 4)
    times, travelled = _progress(drive, preset.speed, start)
    return Road([center, *_side_streets([center], preset, rng)], 1, drive, times, travelled)


def _indoors(kind: str, preset: Preset, rng: np.random.Generator, length: float) -> Road:
    """A closed path through a building: it leads through doors and comes back."""
    if kind not in ("loop", "random"):
        raise UsageError(f"--road {kind}: indoors the route leads through rooms; want loop or random")
    plan = (office if preset.indoor == "rooms" else car_park)(length, rng)
    corners = Path(plan.way, True)
    drive = Path(_smooth(corners.xy[:-1], 0.3 if preset.indoor == "rooms" else 1.5, True), True)
    times, travelled = _progress(drive, preset.speed, 0.0)
    return Road([drive], 1, drive, times, travelled, plan=plan)


MARGIN = 110.0
"""Length of road behind the start and beyond the end of an open drive, m: beyond the LiDAR's range."""


def _center_line(kind: str, preset: Preset, rng: np.random.Generator, length: float) -> Path:
    if kind == "random":
        if preset.degenerate:
            kind = "arc"
        else:
            kind = str(rng.choice(["loop", "blob", "wave", "figure8"], p=[0.35, 0.25, 0.3, 0.1]))
    rotation = rng.uniform(0, 2 * np.pi)
    t = np.linspace(0, 1, 1024, endpoint=False)
    if kind == "straight":
        xy = np.stack([np.linspace(-MARGIN, length + MARGIN, 1024), np.zeros(1024)], -1)
    elif kind == "arc":  # constant curvature: as degenerate as a straight road
        radius = rng.choice([-1, 1]) * rng.uniform(400, 3000)
        a = np.linspace(-MARGIN, length + MARGIN, 4096) / radius
        xy = np.stack([np.sin(a), 1 - np.cos(a)], -1) * radius
    elif kind == "wave":
        x = np.linspace(-MARGIN, length + MARGIN, 2048)
        wave = sum(a * np.sin(2 * np.pi * x / w + p) for a, w, p in zip(
            rng.uniform(2, 14, 3), rng.uniform(90, 300, 3), rng.uniform(0, 6.3, 3), strict=True))  # fmt: skip
        xy = np.stack([x, wave], -1)
    elif kind == "figure8":
        xy = np.stack([np.sin(2 * np.pi * t), 0.8 * np.sin(4 * np.pi * t)], -1)
    elif kind == "blob":
        radius = 1 + sum(a * np.cos(2 * np.pi * k * t + p) for k, a, p in zip(
            (2, 3, 4, 5), rng.uniform(0.02, 0.13, 4), rng.uniform(0, 6.3, 4), strict=True))  # fmt: skip
        xy = radius[:, None] * np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)], -1)
    else:
        a = rng.uniform(1.2, 2.0)
        xy = np.array([[0, 0], [a, 0], [a, 1], [0, 1]])
        xy = np.concatenate(
            [np.linspace(p, q, 256, endpoint=False) for p, q in zip(xy, np.roll(xy, -1, 0), strict=True)]
        )
    closed = kind in ("loop", "blob", "figure8")
    if closed:
        shape = Path(xy, True)
        # Gaussian smoothing rounds the corners with gradually changing curvature, as real streets do.
        shape = Path(shape.xy[:-1] * length / shape.length, True)
        path = Path(_smooth(shape.xy[:-1], float(np.clip(length / 11, 4.0, 12.0)), True), True)
        xy = path.xy[:-1] * length / path.length
    R = np.array([[np.cos(rotation), -np.sin(rotation)], [np.sin(rotation), np.cos(rotation)]])
    return Path(xy @ R.T, closed)


def _smooth(xy: Array, sigma: float, closed: bool) -> Array:
    """Gaussian smoothing by `sigma` m of samples about `STEP` m apart; the ends of an open line stay."""
    if closed:
        return gaussian_filter1d(xy, sigma / STEP, axis=0, mode="wrap")
    # reflection through the end point keeps both the end and its direction
    n = min(len(xy) - 1, int(4 * sigma / STEP) + 1)
    padded = np.concatenate([2 * xy[0] - xy[n:0:-1], xy, 2 * xy[-1] - xy[-2 : -n - 2 : -1]])
    return gaussian_filter1d(padded, sigma / STEP, axis=0)[n:-n]


def _progress(path: Path, speed: float, start: float) -> tuple[Array, Array]:
    """Times and arc lengths of a comfortable drive from `start`: 4 m/s^2 lateral, 1.5 m/s^2 longitudinal."""
    laps = 3 if path.closed else 1  # the middle lap of three is periodic
    curvature = np.abs(np.gradient(path.yaw, path.s))
    curvature = np.maximum(gaussian_filter1d(curvature, 4, mode="wrap" if path.closed else "nearest"), 1e-4)
    speeds = speed * (1 + 0.08 * np.sin(2 * np.pi * path.s / path.length * max(1, round(path.length / 90))))
    speed_squared = np.tile(np.minimum(speeds**2, 4.0 / curvature)[: -1 if path.closed else None], laps)
    s = np.arange(len(speed_squared)) * (path.s[1] - path.s[0])
    ramp = 2 * 1.5 * s
    speed_squared = np.minimum(np.minimum.accumulate(speed_squared - ramp) + ramp, speed_squared)
    speed_squared = np.minimum((np.minimum.accumulate((speed_squared + ramp)[::-1])[::-1]) - ramp, speed_squared)
    if path.closed:
        n = len(speed_squared) // 3
        speed_squared = np.concatenate([speed_squared[n : 2 * n], speed_squared[n : n + 1]])
    speeds = np.sqrt(speed_squared)
    first = int(np.searchsorted(path.s, start))
    times = np.concatenate([[0.0], np.cumsum(np.diff(path.s[first:]) * 2 / (speeds[first:-1] + speeds[first + 1 :]))])
    return times, path.s[first:]


def _side_streets(streets: list[Path], preset: Preset, rng: np.random.Generator) -> list[Path]:
    """Branches to one side or both; a branch that meets the main road again ends there."""
    tree = cKDTree(np.concatenate([p.xy for p in streets]))
    found: list[Path] = []
    for street in streets:
        s = rng.uniform(20, 60)
        while preset.side_streets > 0 and s < street.length - 20:
            (foot,), (yaw,) = street.at(s)
            for side in rng.choice([-1, 1], rng.integers(1, 3), replace=False):
                heading = yaw + side * np.pi / 2 + rng.normal(0, 0.12)
                reach = np.arange(0, rng.uniform(45, 110), STEP)
                xy = foot + reach[:, None] * np.array([np.cos(heading), np.sin(heading)])
                meetings = np.flatnonzero((reach > 25) & (tree.query(xy)[0] < STEP))
                xy = xy[: meetings[0] + 1] if len(meetings) else xy
                clear = tree.query(xy[reach[: len(xy)] > 18])[0] > 14
                if clear.all() or len(meetings):
                    found.append(Path(xy))
            s += rng.exponential(100 / preset.side_streets) + 22
    return found


def read_drive(path: FilePath) -> Array:
    """(N, 4) positions in a file of KITTI poses, x ahead at the start, y left, z up, m, and headings, rad.

    Raises:
        UsageError: no such file, or a line without 12 finite numbers; the message names the line.
    """
    if not path.is_file():
        raise UsageError(f"--road {path}: want one of {', '.join(ROAD_KINDS)}, or a file of KITTI poses")
    rows = read_numbers(path, 12)
    heading = np.arctan2(-rows[:, 2], rows[:, 10])  # of the camera's z axis, which points ahead
    return np.concatenate([rows[:, [11, 3, 7]] * (1, -1, -1), np.unwrap(heading)[:, None]], 1)


def _road_of_poses(file: FilePath, preset: Preset, rng: np.random.Generator) -> Road:
    position = read_drive(file)
    steps = np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1)
    if steps.sum() < 20:
        raise UsageError(f"--road {file}: a drive of {steps.sum():.0f} m; want at least 20 m")
    # At standstill the heading is noise: the path leaves these frames out, the progress keeps them.
    keep = np.concatenate([[True], np.diff(np.floor(np.cumsum(steps) / STEP)) > 0, [True]])
    raw = Path(position[keep, :2])
    smooth = _smooth(raw.xy, 2.0, False)
    drive = Path(smooth)
    arc = arc_lengths(position[:, :2])
    raw_arc = np.interp(arc, arc[keep], arc_lengths(position[keep, :2]))
    travelled: Array = np.interp(raw_arc, raw.s, arc_lengths(smooth))
    center = drive.shifted(preset.lane)
    z = gaussian_filter1d(np.interp(drive.s, travelled, position[:, 2]), 4)
    z = np.interp(np.linspace(0, 1, len(center.xy)), np.linspace(0, 1, len(z)), z)
    n = int(MARGIN / STEP)
    margin = np.arange(1, n + 1)[:, None] * STEP
    heading = np.stack([np.cos(center.yaw[[0, -1]]), np.sin(center.yaw[[0, -1]])], -1)
    xy = np.concatenate([center.xy[0] - margin[::-1] * heading[0], center.xy, center.xy[-1] + margin * heading[1]])
    z = np.pad(z, n, mode="edge")
    pieces = list(_first_visits(xy))
    streets = [Path(xy[a:b]) for a, b in pieces]
    heights = [
        np.interp(p.s, np.linspace(0, p.length, b - a), z[a:b]) for p, (a, b) in zip(streets, pieces, strict=True)
    ]
    sides = _side_streets(streets, preset, rng)
    times = np.arange(len(position), dtype=float) * FRAME_PERIOD
    slip = position[:, 3] - np.interp(travelled, drive.s, drive.yaw)
    slip = np.remainder(slip + np.pi, 2 * np.pi) - np.pi
    return Road([*streets, *sides], len(streets), drive, times, travelled, heights, slip)


def _first_visits(xy: Array) -> Iterator[tuple[int, int]]:
    """Runs [a, b) of samples that do not return to within 5 m of a position passed more than 30 m earlier."""
    pairs = cKDTree(xy).query_pairs(5.0, output_type="ndarray")
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 30.0 / STEP]
    is_first = np.ones(len(xy), bool)
    is_first[pairs.max(1)] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_first.astype(np.int8), [0]])))
    return ((int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a > 3)
