# SPDX-License-Identifier: Apache-2.0
"""What the search for loops costs a keyframe as the map grows: keyframes of random descriptors, but a real network."""

from __future__ import annotations

from time import process_time
from typing import Any

import numpy as np
from rich.console import Group
from rich.progress import Progress

from dpm2_core.config import load_settings
from dpm2_core.descriptors import Descriptors
from dpm2_core.evaluation.bench.harness import Options, Report
from dpm2_core.frame import Keyframe, Points, Registration
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.world import build_world
from dpm2_core.slam.system import Config, make_loops

SIZES = (100, 1000, 5000, 20000)
_MEASURED = 15  # keyframes at each size
_EDGE = Registration(np.eye(4), np.eye(6) * 1e-4, 1.0, 0.1, "made")


def bench_loop_cost(options: Options) -> Report:
    """CPU time of `LoopCloser.close` a keyframe in maps of each size; candidates are registered, none is a loop."""
    settings = load_settings(Config, None, [f"slam.threads={options.threads}", *options.overrides]).slam
    settings = settings.model_copy(update={"loops": settings.loops.model_copy(update={"min_confidence": 0.0})})
    world = build_world("straight", "suburb", seed=8, length=100.0)
    cloud = Lidar().scan(world, world.pose_at(60.0), 0.0, np.random.default_rng(0)).points
    rng, keyframes, cost = np.random.default_rng(0), [], {}
    loops = make_loops(settings)
    poses = np.tile(np.eye(4), (max(SIZES) + _MEASURED, 1, 1))
    poses[:, 0, 3] = 5.0 * np.arange(len(poses))  # a straight road of 100 km
    with Progress(transient=True) as progress:
        task = progress.add_task("map", total=max(SIZES) + _MEASURED)
        for node in range(len(poses)):
            keyframes.append(_keyframe(node, poses[node], cloud, rng))
            progress.advance(task)
    for size in SIZES:
        clouds = [cloud] * len(keyframes)
        seconds = []
        loops.close(keyframes[:size], clouds, poses[:size])  # takes in all that is new
        for last in range(size + 1, size + _MEASURED):
            started = process_time()
            loops.close(keyframes[:last], clouds, poses[:last])
            seconds.append(process_time() - started)
        cost[str(size)] = round(1e3 * float(np.median(seconds)), 1)
    results: dict[str, Any] = {"cpu_ms": cost, "ratio": round(cost[str(SIZES[-1])] / cost[str(SIZES[0])], 2)}
    return Report(results, Group(str(results)))


def _keyframe(node: int, T: np.ndarray, cloud: Points, rng: np.random.Generator) -> Keyframe:
    """One with random descriptors of 16 directions, so that no two places are alike."""
    features = rng.normal(size=(256, 16)) @ rng.normal(size=(16, 128))
    xyz = (rng.normal(size=(256, 3)) * (20, 20, 2)).astype(np.float32)
    return Keyframe(node, node, node, se3.make(np.eye(3), T[:3, 3]), cloud[:0], _EDGE if node else None, "",
                    Descriptors(xyz, features.astype(np.float16)))  # fmt: skip
