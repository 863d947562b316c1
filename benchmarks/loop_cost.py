# SPDX-License-Identifier: Apache-2.0
"""Time and memory per keyframe as the map grows: keyframes with random descriptors, but a real network."""

from __future__ import annotations

from time import process_time
from typing import Any

import numpy as np
from rich.console import Group

from benchmarks.harness import Options, Report, settings_of
from benchmarks.resident import resident_mb
from dpm2_core.console import tracked
from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Keyframe, Registration
from dpm2_core.frame import NO_POINTS, Array
from dpm2_core.geometry import se3
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_loops

SIZES = (100, 1000, 5000, 20000)
_MEASURED = 15  # keyframes at each size
_EDGE = Registration(np.eye(4), np.eye(6) * 1e-4, 1.0, 0.1, "made")


def bench_loop_cost(options: Options) -> Report:
    """CPU time of `LoopCloser.close` per keyframe in maps of each size; candidates are compared, none is a loop.

    And the resident memory of the largest map, with the clouds on disk.
    """
    settings = settings_of(options)
    world = build_world("straight", "suburb", seed=8, length=100.0)
    cloud = Lidar().scan(world, world.pose_at(60.0), 0.0, np.random.default_rng(0)).points
    rng, cost = np.random.default_rng(0), dict[str, float]()
    loops = make_loops(settings)
    poses = np.tile(np.eye(4), (max(SIZES) + _MEASURED, 1, 1))
    poses[:, 0, 3] = 5.0 * np.arange(len(poses))  # a straight road of 100 km
    parts = np.zeros(len(poses), np.intp)  # all are connected
    smallest = SIZES[0]
    keyframes = [_keyframe(node, T, rng) for node, T in enumerate(poses[:smallest])]
    # Lets torch allocate its memory.
    make_loops(settings).close(keyframes, [cloud] * smallest, poses[:smallest], parts[:smallest])
    empty = resident_mb()
    for node in tracked(range(smallest, len(poses)), "map"):
        keyframes.append(_keyframe(node, poses[node], rng))
    for size in SIZES:
        clouds = [cloud] * len(keyframes)
        seconds = []
        loops.close(keyframes[:size], clouds, poses[:size], parts[:size])  # adds all new keyframes
        for last in range(size + 1, size + _MEASURED):
            started = process_time()
            loops.close(keyframes[:last], clouds, poses[:last], parts[:last])
            seconds.append(process_time() - started)
        cost[str(size)] = round(1e3 * float(np.median(seconds)), 1)
    results: dict[str, Any] = {
        "cpu_ms": cost,
        "ratio": round(cost[str(SIZES[-1])] / cost[str(smallest)], 2),
        "rss_kb_a_keyframe": round(1e3 * (resident_mb() - empty) / (len(keyframes) - smallest), 1),
    }
    return Report(results, Group(str(results)))


def _keyframe(node: int, T: Array, rng: np.random.Generator) -> Keyframe:
    """A keyframe with random descriptors of 16 directions, so that no two places are alike."""
    features = rng.normal(size=(256, 16)) @ rng.normal(size=(16, 128))
    xyz = (rng.normal(size=(256, 3)) * (20, 20, 2)).astype(np.float32)
    return Keyframe(node, node, node, se3.make(np.eye(3), T[:3, 3]), NO_POINTS, _EDGE if node else None, "",
                    Descriptors.of(xyz, features))  # fmt: skip
