# SPDX-License-Identifier: Apache-2.0
"""Benchmarks that can be repeated: each is a function from `Options` to a `Report`, found by its name in `BENCHES`."""

from __future__ import annotations

from collections.abc import Callable

from dpm2_core.evaluation.bench.geometric import bench_geometric
from dpm2_core.evaluation.bench.harness import Options, Report
from dpm2_core.evaluation.bench.memory import bench_memory


def bench_neural(options: Options) -> Report:
    """See `neural.bench_neural`; torch is imported only for it."""
    from dpm2_core.evaluation.bench import neural

    return neural.bench_neural(options)


def bench_pose_graph(options: Options) -> Report:
    """See `pose_graph.bench_pose_graph`; gtsam is imported only for it."""
    from dpm2_core.evaluation.bench import pose_graph

    return pose_graph.bench_pose_graph(options)


BENCHES: dict[str, Callable[[Options], Report]] = {
    "geometric": bench_geometric,
    "memory": bench_memory,
    "neural": bench_neural,
    "pose-graph": bench_pose_graph,
}
"""By the name that `dpm2 bench NAME` and `benchmarks/NAME.json` share."""
