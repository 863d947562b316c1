# SPDX-License-Identifier: Apache-2.0
"""Benchmarks that can be repeated: each is a function from `Options` to a `Report`, found by its name in `BENCHES`."""

from __future__ import annotations

from collections.abc import Callable

from dpm2_core.evaluation.bench.geometric import bench_geometric
from dpm2_core.evaluation.bench.harness import Options, Report
from dpm2_core.evaluation.bench.memory import bench_memory


def bench_diffslam(options: Options) -> Report:
    """See `diffslam.bench_diffslam`; the simulator and torch are imported only for it."""
    from dpm2_core.evaluation.bench import diffslam

    return diffslam.bench_diffslam(options)


def bench_loop_cost(options: Options) -> Report:
    """See `loop_cost.bench_loop_cost`."""
    from dpm2_core.evaluation.bench import loop_cost

    return loop_cost.bench_loop_cost(options)


def bench_map(options: Options) -> Report:
    """See `map.bench_map`; the simulator is imported only for it."""
    from dpm2_core.evaluation.bench import map

    return map.bench_map(options)


def bench_neural(options: Options) -> Report:
    """See `neural.bench_neural`; torch is imported only for it."""
    from dpm2_core.evaluation.bench import neural

    return neural.bench_neural(options)


def bench_relocalise(options: Options) -> Report:
    """See `relocalise.bench_relocalise`."""
    from dpm2_core.evaluation.bench import relocalise

    return relocalise.bench_relocalise(options)


def bench_roads(options: Options) -> Report:
    """See `roads.bench_roads`; the simulator and torch are imported only for it."""
    from dpm2_core.evaluation.bench import roads

    return roads.bench_roads(options)


def bench_pose_graph(options: Options) -> Report:
    """See `pose_graph.bench_pose_graph`; gtsam is imported only for it."""
    from dpm2_core.evaluation.bench import pose_graph

    return pose_graph.bench_pose_graph(options)


def bench_tasks(options: Options) -> Report:
    """See `tasks.bench_tasks`; the simulator and torch are imported only for it."""
    from dpm2_core.evaluation.bench import tasks

    return tasks.bench_tasks(options)


def bench_traffic(options: Options) -> Report:
    """See `traffic.bench_traffic`; the simulator and torch are imported only for it."""
    from dpm2_core.evaluation.bench import traffic

    return traffic.bench_traffic(options)


def bench_finetune(options: Options) -> Report:
    """See `finetune.bench_finetune`."""
    from dpm2_core.evaluation.bench import finetune

    return finetune.bench_finetune(options)


BENCHES: dict[str, Callable[[Options], Report]] = {
    "diffslam": bench_diffslam,
    "finetune": bench_finetune,
    "geometric": bench_geometric,
    "loop-cost": bench_loop_cost,
    "map": bench_map,
    "memory": bench_memory,
    "neural": bench_neural,
    "pose-graph": bench_pose_graph,
    "relocalise": bench_relocalise,
    "roads": bench_roads,
    "tasks": bench_tasks,
    "traffic": bench_traffic,
}
"""By the name that `dpm2 bench NAME` and `benchmarks/NAME.json` share."""
