# SPDX-License-Identifier: Apache-2.0
"""The network on scans of LiDARs that differ from most of those used in training, in unseen worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Options
from benchmarks.pairs import MANY, summarized
from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.evaluation.pair_set import PairSet
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pyramid import crop
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import build_world

SENSORS = {
    "16 beams": LidarConfig(beams=16),
    "32 beams": LidarConfig(beams=32),
    "64 beams": LidarConfig(beams=64),
    "128 beams": LidarConfig(beams=128, columns=1024),
    "rosette": LidarConfig(beams=16, columns=1500, pattern="rosette"),
}
"""With the errors of a real sensor; the rosette sees 70 degrees ahead and never repeats."""
FIRST_SEED = 960_000
PLACES: tuple[PresetName, ...] = ("city", "suburb", "rural", "suburb")
FARTHEST = 12.0
"""Largest distance between the scans of a pair, m."""


def other_sensors(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Pairs up to 12 m apart with each sensor, without a prior; for all-round sensors also with random yaw."""
    out: dict[str, Any] = {}
    for name, clean in SENSORS.items():
        folder = sensor_drives(name, network, options)
        rows = PairSet(folder, MANY * options.pairs, network.settings, images=False).errors(network)
        near, is_turned = rows[:, 0] <= FARTHEST, rows[:, 1] > 0
        out[f"{name}, up to {FARTHEST:g} m"] = {"neural": summarized(rows[near & ~is_turned, 2:4])}
        if clean.pattern == "spinning":
            out[f"{name}, up to {FARTHEST:g} m, any yaw"] = {"neural": summarized(rows[near & is_turned, 2:4])}
    return {"pairs": out}


def sensor_drives(name: str, network: DeepPointMap2, options: Options) -> Path:
    """Folder of packed drives: those that were given, or new ones with this sensor, which later runs reuse."""
    if options.unseen is not None:
        return options.unseen
    root = options.cache / f"{network.settings.preset}_sensors" / name.replace(" ", "_")
    for i, place in enumerate(PLACES):
        folder = root / str(i)
        if not folder.exists():
            drive(folder, place, FIRST_SEED + i, SENSORS[name], network.settings)
    return root


def drive(
    folder: Path, place: PresetName, seed: int, clean: LidarConfig, network: NetworkSettings, scans: int = 24
) -> None:
    """Pack scans of one world; each sensor has the same poses."""
    world, noise = build_world("random", place, seed), np.random.default_rng(seed)
    lidar = Lidar(real_sensor(clean))
    height, sway = lidar.config.height, lidar.config.real.sway
    samples = list[Sample]()
    for _ in range(scans):
        T, time = world.sample_pose(noise, height=height, sway=sway)
        scan_noise = np.random.default_rng([seed, len(samples)])
        scan = lidar.drive_scan(world, T @ lidar.T_level_lidar, time, scan_noise)
        level = se3.transform(lidar.T_level_lidar, scan.points).astype(np.float32)
        samples.append(Sample(crop(level, network.points), T, ()))
    write_packed(folder, samples, {"source": "synthetic city", "preset": place, "seed": seed})
