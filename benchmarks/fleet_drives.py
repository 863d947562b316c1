# SPDX-License-Identifier: Apache-2.0
"""Maps of drives as from `dpm2 fleet run`, but made in less time: keyframes every few meters of a simulated road."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np

from dpm2_core.data.trajectory import arc_lengths, read_trajectory, write_kitti
from dpm2_core.estimates import Keyframe, Registration, isotropic
from dpm2_core.fleet.drives import MAP
from dpm2_core.fleet.part import DONE
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.network.pretrained import weights_id
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import World
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_store import MapStore

STEP = 5.0
"""m between two keyframes."""
_DRIFT = np.array([0, 0, 3e-4, 0.01, 0.006, 0.0])  # of the odometry, per keyframe, rad and m
_COVARIANCE = isotropic(1e-3, 0.03)
_DRIVE_INTERVAL = 100.0  # s between two drives, so that the traffic differs


def chained(files: Sequence[Path], meters: float, out: Path) -> None:
    """Write the first `meters` of each file of KITTI poses as one path; each road begins where the last one ends."""
    parts, T_path_road = [], np.eye(4)
    for file in files:
        poses = read_trajectory(file).poses
        distance = arc_lengths(poses[:, :3, 3])
        part = T_path_road @ se3.inverse(poses[0]) @ poses[distance < meters]
        parts.append(part[:-1])
        T_path_road = part[-1]
    write_kitti(out, np.concatenate(parts))


def poses_of(world: World, span: tuple[float, float], seed: int) -> Array:
    """(N, 4, 4) true keyframe poses of a drive, slightly off the lane; `span`: m of the path, `seed`: of the offset."""
    rng = np.random.default_rng(seed)
    T_lane_drive = se3.exp(np.append(rng.normal(size=3) * [0, 0, 0.02], rng.normal(size=3) * [0, 0.3, 0]))
    return np.array([world.pose_at(float(s)) for s in np.arange(*span, STEP)]) @ T_lane_drive


def odometry_of(poses: Array) -> Array:
    """(N, 4, 4) poses from a drifting odometry."""
    steps = se3.inverse(poses[:-1]) @ poses[1:] @ se3.exp(_DRIFT)
    return np.array(list(accumulate(steps, np.matmul, initial=np.eye(4))))


def write_drive(folder: Path, world: World, poses: Array, seed: int) -> None:
    """Write a drive as the SLAM maps it.

    Args:
        folder: must not exist. poses: (N, 4, 4) true, of its keyframes. seed: of noise and traffic.
    """
    rng, lidar, settings = np.random.default_rng([seed, 1]), Lidar(LidarConfig(columns=1024)), SlamSettings()
    odometry = odometry_of(poses)
    folder.mkdir(parents=True)
    with MapStore.create(folder / MAP) as store:
        store.begin_session("", weights_id(settings.neural.weights))
        mapper, edge = make_mapper(settings, store), None
        for number, T_world_kf in enumerate(poses):
            scan = lidar.scan(world, T_world_kf, _DRIVE_INTERVAL * seed + number / 2, rng)
            if number:
                T = se3.inverse(odometry[number - 1]) @ odometry[number]
                edge = Registration(T, _COVARIANCE, 0.9, 0.05, "simulated")
            cloud = scan.points[voxel_first(scan.points, 0.3, far=60.0)]
            mapper.add(Keyframe(number, number * 10**9, number, odometry[number], cloud, edge))
        mapper.finish()
    (folder / DONE).write_text(json.dumps({"files": {MAP: (folder / MAP).stat().st_size}}))
