# SPDX-License-Identifier: Apache-2.0
"""Maps of drives as a fleet leaves them, without driving: keyframes every few meters of a simulated road."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dpm2_core.fleet.drives import MAP
from dpm2_core.fleet.part import DONE
from dpm2_core.frame import Array, Keyframe, Registration
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.network.pretrained import weights_path
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import World
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.store.rows import weights_id

DRIFT = np.array([0, 0, 3e-4, 0.01, 0.006, 0.0])
"""Of the odometry, a keyframe, rad and m."""


def write_drive(folder: Path, world: World, at: Array, seed: int) -> Array:
    """A drive along the road of a world, with a keyframe at each of (N,) m; its true poses (N, 4, 4)."""
    rng, lidar = np.random.default_rng(seed), Lidar(LidarConfig(columns=1024))
    aside = se3.exp(np.append(rng.normal(size=3) * [0, 0, 0.02], rng.normal(size=3) * [0, 0.3, 0]))
    poses = np.array([world.pose_at(float(s)) for s in at]) @ aside
    folder.mkdir(parents=True)
    settings = SlamSettings()
    with MapStore.create(folder / MAP) as store:
        store.begin_session("", weights_id(weights_path(settings.neural.weights)))
        mapper, before = make_mapper(settings, store), None
        for number, T_world_kf in enumerate(poses):
            scan = lidar.scan(world, T_world_kf, 100.0 * seed + number / 2, rng)
            near = scan.points[np.einsum("ij,ij->i", scan.points[:, :3], scan.points[:, :3]) < 60.0**2]
            edge, T_odom_kf = None, np.eye(4)
            if before is not None:
                T = se3.inverse(poses[number - 1]) @ T_world_kf @ se3.exp(DRIFT)
                edge = Registration(T, np.diag([1e-3] * 3 + [0.03] * 3) ** 2, 0.9, 0.05, "simulated")
                T_odom_kf = before.T_odom_kf @ T
            cloud = near[voxel_first(near, 0.3)]
            before = Keyframe(number, number * 10**9, number, T_odom_kf, cloud, edge)
            mapper.add(before)
        mapper.finish()
    size = (folder / MAP).stat().st_size
    (folder / DONE).write_text(json.dumps({"files": {MAP: size}}))
    return poses
