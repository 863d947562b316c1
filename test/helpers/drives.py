# SPDX-License-Identifier: Apache-2.0
"""Drives through the synthetic city, in memory and as the start of a recording, and their odometry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from dpm2_core.data.source import IndexedSource
from dpm2_core.estimates import OdometryResult
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings

Drive = tuple[list[Frame], Array]
"""Frames and their (N, 4, 4) true poses relative to the first."""


class InMemory(IndexedSource):
    """A source of these frames."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__("memory", len(frames))
        self.all = frames

    def frame(self, position: int) -> Frame:
        return self.all[position]


@cache
def street(preset: PresetName, seed: int, length: float = 160.0) -> World:
    """A straight road of `length` m. Building one takes seconds."""
    return build_world("straight", preset, seed=seed, length=length)


def straight(preset: PresetName) -> World:
    """200 m of a straight road."""
    return street(preset, 11, 200.0)


def make_drive(preset: PresetName, frames: int, *, deskewed: bool = True, start: float = 2.0) -> Drive:
    """A drive at 10 Hz that starts `start` s after the beginning of the world's drive."""
    world = straight(preset)
    lidar = Lidar(LidarConfig(columns=1024))
    rng = np.random.default_rng(0)
    poses = np.array([world.drive_pose(start + 0.1 * i) for i in range(frames)])
    out = []
    for i, T in enumerate(poses):
        twist = None
        if not deskewed:
            after = world.drive_pose(start + 0.1 * i + 0.01)
            twist = se3.way(T, after) / 0.01
        scan = lidar.scan(world, T, start + 0.1 * i, rng, twist=twist)
        out.append(Frame(i * 10**8, scan.points, None if deskewed else scan.time_offset, index=i))
    return out, se3.inverse(poses[0]) @ poses


def in_parts(frames: Iterable[Frame], count: int = 10) -> list[Frame]:
    """Each sweep sent in so many parts, as by a driver that publishes each packet: stamped at their start."""
    parts = list[Frame]()
    for frame in frames:
        assert frame.time_offset is not None
        edges = np.linspace(frame.time_offset.min(), frame.time_offset.max() + 1e-6, count + 1)
        for start, end in pairwise(edges):
            inside = (frame.time_offset >= start) & (frame.time_offset < end)
            cloud = replace(frame, points=frame.points[inside], time_offset=frame.time_offset[inside])
            parts.append(replace(cloud.later(start), index=len(parts)))
    return parts


def track(frames: Iterable[Frame], **settings: object) -> list[OdometryResult]:
    """Odometry results of the frames; `settings` of the SLAM that differ from the default."""
    odometry = make_odometry(SlamSettings.model_validate(settings))
    return [odometry.process(frame) for frame in frames]


def off(tracked: Sequence[OdometryResult], poses: Array) -> Array:
    """Errors (N,) of the positions relative to the first, m."""
    T_odom_lidar = np.array([t.T_odom_lidar for t in tracked])
    T = se3.inverse(se3.inverse(poses[0]) @ poses) @ se3.inverse(T_odom_lidar[0]) @ T_odom_lidar
    return np.asarray(np.linalg.norm(T[:, :3, 3], axis=1))


def first_scans(recording: Path, count: int, out: Path) -> Path:
    """The first scans of a simulated recording without images, as a recording of its own in `out`. Scans are links."""
    for file in sorted(path for path in recording.rglob("*") if path.is_file()):
        to = out / file.relative_to(recording)
        to.parent.mkdir(parents=True, exist_ok=True)
        if file.name in ("times.txt", "poses.txt") or file.parent.name == "poses":
            to.write_text("".join(file.read_text().splitlines(keepends=True)[:count]))
        elif not file.stem.isdigit() or int(file.stem) < count:
            to.symlink_to(file)
    return out
