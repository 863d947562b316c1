# SPDX-License-Identifier: Apache-2.0
"""A small drive through the synthetic city, with exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import build_world

Drive = tuple[list[Frame], Array]


def make_drive(preset: str, frames: int, *, deskewed: bool = True, start: float = 2.0) -> Drive:
    """Frames of a drive at 10 Hz and the (N, 4, 4) true poses relative to the first."""
    world = build_world("straight", preset, seed=11, length=200.0)
    lidar = Lidar(LidarConfig(columns=1024))
    rng = np.random.default_rng(0)
    poses = np.array([world.drive_pose(start + 0.1 * i) for i in range(frames)])
    out = []
    for i, T in enumerate(poses):
        twist = None
        if not deskewed:
            after = world.drive_pose(start + 0.1 * i + 0.01)
            twist = se3.log(se3.inverse(T) @ after) / 0.01
        scan = lidar.scan(world, T, start + 0.1 * i, rng, twist=twist)
        out.append(Frame(i * 10**8, scan.points, None if deskewed else scan.time_offset, index=i))
    return out, se3.inverse(poses[0]) @ poses


@pytest.fixture(scope="session")
def suburb() -> Drive:
    return make_drive("suburb", 30)


@pytest.fixture(scope="session")
def tunnel() -> Drive:
    return make_drive("tunnel", 12)
