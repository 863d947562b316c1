# SPDX-License-Identifier: Apache-2.0
"""Maps of drives as `dpm2 fleet run` leaves them, without its hours: keyframes every few meters of a simulated road."""

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

STEP = 5.0
"""m between two keyframes."""
_DRIFT = np.array([0, 0, 3e-4, 0.01, 0.006, 0.0])  # of the odometry, a keyframe, rad and m
_TRAFFIC = 100.0  # s between two drives: by then other cars are there


def write_drive(folder: Path, world: World, span: tuple[float, float], seed: int) -> Array:
    """A drive along the road of a world, a little beside the lane, with drifting odometry.

    Args:
        folder: new. span: m of the way, first and last. seed: of noise, traffic and place in the lane.

    Returns:
        (N, 4, 4) true poses of its keyframes.
    """
    rng, lidar, settings = np.random.default_rng(seed), Lidar(LidarConfig(columns=1024)), SlamSettings()
    aside = se3.exp(np.append(rng.normal(size=3) * [0, 0, 0.02], rng.normal(size=3) * [0, 0.3, 0]))
    poses = np.array([world.pose_at(float(s)) for s in np.arange(*span, STEP)]) @ aside
    folder.mkdir(parents=True)
    with MapStore.create(folder / MAP) as store:
        store.begin_session("", weights_id(weights_path(settings.neural.weights)))
        mapper, before = make_mapper(settings, store), None
        for number, T_world_kf in enumerate(poses):
            scan = lidar.scan(world, T_world_kf, _TRAFFIC * seed + number / 2, rng)
            near = scan.points[np.einsum("ij,ij->i", scan.points[:, :3], scan.points[:, :3]) < 60.0**2]
            edge, T_odom_kf = None, np.eye(4)
            if before is not None:
                T = se3.inverse(poses[number - 1]) @ T_world_kf @ se3.exp(_DRIFT)
                edge = Registration(T, np.diag([1e-3] * 3 + [0.03] * 3) ** 2, 0.9, 0.05, "simulated")
                T_odom_kf = before.T_odom_kf @ T
            before = Keyframe(number, number * 10**9, number, T_odom_kf, near[voxel_first(near, 0.3)], edge)
            mapper.add(before)
        mapper.finish()
    (folder / DONE).write_text(json.dumps({"files": {MAP: (folder / MAP).stat().st_size}}))
    return poses
