# SPDX-License-Identifier: Apache-2.0
"""Benchmarks, not installed: each is a function from `Options` to a `Report`, found by its name in `BENCHES`."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from dpm2_core.errors import UsageError

if TYPE_CHECKING:
    from benchmarks.harness import Options, Report


@dataclass(frozen=True)
class Bench:
    """A benchmark.

    Attributes:
        function: "module:function" below this package, imported when it runs: what one needs is slow to import.
        options: what of `Options` it makes use of beside `out`, by the names of the command line.
    """

    function: str
    options: frozenset[str]

    def run(self, options: Options) -> Report:
        """The benchmark's outcome."""
        module, _, name = self.function.partition(":")
        report: Report = getattr(import_module(f"{__name__}.{module}"), name)(options)
        return report


def _bench(function: str, options: str) -> Bench:
    return Bench(function, frozenset(options.split()))


BENCHES: dict[str, Bench] = {
    "beside": _bench("beside:bench_beside", "threads set"),
    "covariance": _bench("covariance:bench_covariance", "source threads set pairs only"),
    "diffslam": _bench("diffslam:bench_diffslam", "repetitions threads set"),
    "finetune": _bench("finetune:bench_finetune", "repetitions threads set pairs only"),
    "fleet": _bench("fleet:bench_fleet", "source only"),
    "gaps": _bench("gaps:bench_gaps", "source threads set only"),
    "geometric": _bench("geometric:bench_geometric", "source repetitions threads set"),
    "hard": _bench("hard:bench_hard", "source threads set only"),
    "imu": _bench("imu:bench_imu", "threads set"),
    "indoor": _bench("indoor:bench_indoor", "threads set"),
    "loop-cost": _bench("loop_cost:bench_loop_cost", "threads set"),
    "map": _bench("map:bench_map", "source set"),
    "memory": _bench("memory:bench_memory", "source threads set"),
    "motion": _bench("motion:bench_motion", "threads set"),
    "neural": _bench("neural:bench_neural", "source repetitions threads set unseen pairs only"),
    "paper": _bench("paper:bench_paper", "source threads set only"),
    "pose-graph": _bench("pose_graph:bench_pose_graph", "repetitions"),
    "relocalise": _bench("relocalise:bench_relocalise", "source threads set pairs"),
    "roads": _bench("roads:bench_roads", "source threads set"),
    "sensor": _bench("sensor:bench_sensor", "source"),
    "tilt": _bench("tilt:bench_tilt", "source threads set pairs"),
    "traffic": _bench("traffic:bench_traffic", "repetitions threads set only"),
    "views": _bench("views:bench_views", "source threads set"),
}
"""By the name that `dpm2 bench NAME` and `benchmarks/NAME.json` share."""


def check_options(names: Collection[str], given: Collection[str]) -> None:
    """Reject names of benchmarks that do not exist, and options that one of them would ignore.

    Raises:
        UsageError: says which.
    """
    for name in names:
        if name not in BENCHES:
            raise UsageError(f"{name}: no such benchmark; choose from {', '.join(BENCHES)}")
        if ignored := sorted(set(given) - BENCHES[name].options):
            takes = ", ".join(f"--{option}" for option in sorted(BENCHES[name].options))
            raise UsageError(f"--{ignored[0]}: benchmark {name} has no use for it; it takes {takes}")
