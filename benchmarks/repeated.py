# SPDX-License-Identifier: Apache-2.0
"""Which reference points of a frame meet one of the next frame: by the true motion, with no learning in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.harness import Options, drives, truth_of, unique_name
from dpm2_core.evaluation.figures import bars_png
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pyramid import build_pyramid, crop
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import build_world

WITHIN = (0.2, 0.4)
"""Distances at which two reference points count as the same place, m."""
APART = (1, 3, 8)
"""Frames between the two."""
_CHOSEN_BY = {"farthest points": {"reference": "fps"}, "salient": {"reference": "salient"}}
_SIMULATED: tuple[PresetName, ...] = ("city", "suburb", "rural", "highway", "tunnel", "indoor", "car_park")
_FRAMES, _SEED = 30, 950_000


def repeated(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Shares of every drive and of one simulated drive of each kind, as a real sensor sees it, and a figure of them.

    No simulated ones with `--unseen`.
    """
    found: dict[str, Any] = {}
    with drives(options) as sources:
        for source in sources:
            name = unique_name(source, found)
            found[name] = shares([f.points for f in source.frames()], truth_of(source), network.settings, options.pairs)
    for kind in _SIMULATED if options.unseen is None else ():
        found[f"simulated {kind}"] = shares(*_simulated(kind), network.settings, options.pairs)
    groups = {
        drive: {name: row["1 apart"][f"{WITHIN[0]} m"] for name, row in rows.items()} for drive, rows in found.items()
    }
    title = f"Reference points within {WITHIN[0]} m of one of the next frame"
    bars_png(options.out / "neural_reference.png", groups, title)
    return {"shares": found}


def _simulated(kind: PresetName) -> tuple[list[Points], Array]:
    config = real_sensor(LidarConfig())
    if kind == "indoor":
        config = config.model_copy(update={"height": 1.0, "car_body": False, "min_range": 0.4})
    world, lidar, sway = build_world("random", kind, _SEED, 200.0), Lidar(config), config.real.sway
    clouds, poses = [], []
    for i in range(_FRAMES):
        time = 0.1 * i if kind != "indoor" else 0.5 * i  # a robot at 1.2 m/s: every fifth scan
        T = world.drive_pose(time, config.height, sway)
        twist = world.drive_twist(time, config.height, sway)
        clouds.append(lidar.drive_scan(world, T, time, np.random.default_rng([_SEED, i]), twist).points)
        poses.append(T @ lidar.T_level_lidar)
    return clouds, np.stack(poses)


def shares(clouds: Sequence[Points], poses: Array, network: NetworkSettings, most: int) -> dict[str, Any]:
    """By the way that they are chosen and the frames between: the mean over at most `most` pairs."""
    cropped = [crop(cloud, network.points) for cloud in clouds]
    out: dict[str, Any] = {}
    for name, change in _CHOSEN_BY.items():
        settings = network.model_copy(update={"fusion": network.fusion.model_copy(update=change)})
        chosen = [_references(cloud, settings) for cloud in cropped]
        out[name] = {}
        for apart in APART:
            starts = np.linspace(0, len(clouds) - 1 - apart, max(min(most, len(clouds) - apart), 0)).astype(int)
            pairs = [(a, a + apart) for a in np.unique(starts) if np.isfinite(poses[[a, a + apart]]).all()]
            distance = [
                cKDTree(chosen[b]).query(se3.transform(se3.inverse(poses[b]) @ poses[a], chosen[a]))[0]
                for a, b in pairs
            ]
            met = {f"{limit} m": float(np.mean([(row < limit).mean() for row in distance])) for limit in WITHIN}
            out[name][f"{apart} apart"] = {"pairs": len(pairs), **met}
    return out


def _references(cloud: Points, network: NetworkSettings) -> Array:
    """(n, 3) m: the first points of the pyramid."""
    pyramid = build_pyramid(cloud, network)
    return pyramid.xyz[: min(network.fusion.points, pyramid.count)].astype(float)
