# SPDX-License-Identifier: Apache-2.0
"""Benchmarks, not installed: each is a function from `Options` to a `Report`, `bench_NAME` in the module NAME."""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from typing import TYPE_CHECKING

from dpm2_core.errors import UsageError

if TYPE_CHECKING:
    from benchmarks.harness import Options, Report

BENCHES = {
    "beside": "threads set",
    "covariance": "source threads set pairs only",
    "diffslam": "repetitions threads set",
    "finetune": "repetitions threads set pairs only",
    "fleet": "source only",
    "gaps": "source threads set only",
    "geometric": "source repetitions threads set",
    "hard": "source threads set only",
    "imu": "threads set",
    "indoor": "threads set",
    "loop-cost": "threads set",
    "map": "source set",
    "memory": "source threads set",
    "motion": "threads set",
    "neural": "source repetitions threads set unseen pairs only",
    "paper": "source threads set only",
    "pose-graph": "repetitions",
    "relocalise": "source threads set pairs",
    "roads": "source threads set",
    "sensor": "source",
    "tilt": "source threads set pairs",
    "traffic": "repetitions threads set only",
    "views": "source threads set",
}
"""By the name in `dpm2 bench NAME` and `benchmarks/NAME.json`: the `Options` that the benchmark uses in addition to
`out`, by their names on the command line."""


def run(name: str, options: Options) -> Report:
    """Run a benchmark; its module is imported only now, since its imports may be slow."""
    module = name.replace("-", "_")
    report: Report = getattr(import_module(f"{__name__}.{module}"), f"bench_{module}")(options)
    return report


def check_options(names: Collection[str], given: Collection[str]) -> None:
    """Reject unknown names of benchmarks, and options that one of them would ignore.

    Raises:
        UsageError: there is such a name or option; the message names it.
    """
    for name in names:
        if name not in BENCHES:
            raise UsageError(f"{name}: no such benchmark; choose from {', '.join(BENCHES)}")
        takes = sorted(BENCHES[name].split())
        if ignored := sorted(set(given) - set(takes)):
            listed = ", ".join(f"--{option}" for option in takes)
            raise UsageError(f"--{ignored[0]}: benchmark {name} does not use it; it uses {listed}")
