# SPDX-License-Identifier: Apache-2.0
"""`dpm2 bench`: run the benchmarks of a source checkout and write down how they were run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from dpm2_core.console import Console
from dpm2_core.errors import UsageError


def bench(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Benchmarks to run: beside, covariance, diffslam, finetune, fleet, gaps, geometric (default), hard, "
            "imu, indoor, loop-cost, map, memory, motion, neural, paper, pose-graph, relocalise, roads, sensor, tilt, "
            "traffic, views."
        ),
    ] = None,
    source: Annotated[
        list[Path] | None,
        typer.Option(
            help="KITTI sequence or bag with ground truth; repeat for more. Default: the KITTI excerpt, packed or in "
            "KITTI layout, in $DPM2_KITTI or ../shared/kitti."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for NAME.json.")] = Path("benchmarks"),
    repetitions: Annotated[
        int | None, typer.Option(min=1, help="Runs of every method on every drive, or number of seeds [3].")
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Processors that every method may use [2].")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Change a setting: KEY=VALUE; repeat for more.")
    ] = None,
    unseen: Annotated[
        Path | None,
        typer.Option(help="neural: packed drives (`dpm2 train data`) to test on, instead of newly simulated worlds."),
    ] = None,
    pairs: Annotated[
        int | None, typer.Option(min=1, help="Number of frame pairs of each kind; relocalise: number of visits [60].")
    ] = None,
    only: Annotated[str | None, typer.Option(help="Run only this part of a benchmark that has several.")] = None,
) -> None:
    """Measure accuracy and speed compared with KISS-ICP on the same scans, memory over a long drive, or the network.

    An option that a benchmark does not use is an error. The message lists the options that it uses.
    """
    _find_benchmarks()
    from benchmarks import check_options, run  # imports the whole SLAM
    from benchmarks.harness import Options, write_report

    names = names or ["geometric"]
    all_options: dict[str, Any] = {
        "source": source, "repetitions": repetitions, "threads": threads, "set": settings,
        "unseen": unseen, "pairs": pairs, "only": only,
    }  # fmt: skip
    given = {option: value for option, value in all_options.items() if value is not None}
    check_options(names, given)
    fields = {"source": "sources", "set": "overrides"}
    options = Options(out=out, **{fields.get(option, option): value for option, value in given.items()})
    for name in names:
        report = run(name, options)
        path = out / f"{name}.json"
        write_report(path, report, options)
        Console().print(report.view, f"written to {path}")


def _find_benchmarks() -> None:
    """Make the package `benchmarks` importable, from the checkout of this code or from the working directory.

    Raises:
        UsageError: neither has it; an installed dpm2 does not include it.
    """
    for root in (Path(__file__).resolve().parents[2], Path.cwd()):
        if (root / "benchmarks" / "harness.py").is_file():
            if str(root) not in sys.path:
                sys.path.insert(0, str(root))
            return
    raise UsageError("dpm2 bench: the benchmarks are not installed; run it in a source checkout of dpm2")
