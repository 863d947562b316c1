# SPDX-License-Identifier: Apache-2.0
"""Worlds and files shared by several tests of the synthetic city."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.sim.world import World, build_world


@pytest.fixture(scope="session")
def city() -> World:
    return build_world("loop", "city", seed=3, length=110)


@pytest.fixture(scope="session")
def tunnel() -> World:
    return build_world("straight", "tunnel", seed=1, length=60)


@pytest.fixture(scope="session")
def highway() -> World:
    return build_world("straight", "highway", seed=1, length=60)


@pytest.fixture(scope="session")
def poses_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """KITTI poses (camera frame) of 1.4 laps around a block, the second lap 0.8 m next to the first, with a stop."""
    s = np.concatenate([np.arange(0, 100, 1.0), np.full(15, 100.0), np.arange(100, 220, 1.0)])
    angle = s / 25.0
    radius = 25 + 0.8 * (angle > 2 * np.pi) + 4 * np.cos(2 * angle)
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), 1.5 * np.sin(angle)
    steeper = -8 * np.sin(2 * angle)  # d radius / d angle
    heading = np.arctan2(steeper * np.sin(angle) + x, steeper * np.cos(angle) - y)
    poses = np.zeros((len(s), 3, 4))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(heading)
    poses[:, 2, 0], poses[:, 0, 2] = np.sin(heading), -np.sin(heading)
    poses[:, 1, 1] = 1.0
    poses[:, :, 3] = np.stack([-y, -z, x], -1)  # right, down, ahead
    poses[:, :, 3] += np.random.default_rng(0).normal(0, 0.003, (len(s), 3))
    path = tmp_path_factory.mktemp("road") / "poses.txt"
    np.savetxt(path, poses.reshape(-1, 12))
    return path
