# SPDX-License-Identifier: Apache-2.0
"""`dpm2 bench`: run the benchmarks and write down how they were run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from dpm2_core.errors import UsageError


def bench(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="diffslam, finetune, geometric (default), loop-cost, map, memory, neural, pose-graph, relocalise, "
            "roads, tasks, traffic."
        ),
    ] = None,
    source: Annotated[
        list[Path] | None, typer.Option(help="A KITTI sequence or bag with ground truth, instead of the excerpt.")
    ] = None,
    kitti: Annotated[
        Path | None, typer.Option(help="KITTI excerpt, packed or in KITTI layout; else $DPM2_KITTI, ../shared/kitti.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for NAME.json.")] = Path("benchmarks"),
    repetitions: Annotated[int, typer.Option(min=1, help="Runs of every method on every drive.")] = 3,
    threads: Annotated[int, typer.Option(min=1, help="Processors that every method may use.")] = 2,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE of the configuration; repeat for more.")
    ] = None,
    weights: Annotated[str | None, typer.Option(help="neural: shipped weights, or a .safetensors file.")] = None,
    unseen: Annotated[
        Path | None, typer.Option(help="neural: packed drives (`dpm2 train data`) instead of new unseen worlds.")
    ] = None,
    pairs: Annotated[int, typer.Option(min=1, help="neural: pairs of frames of each kind.")] = 60,
    only: Annotated[
        str | None, typer.Option(help="neural, tasks: this part alone; else those that NAME.json lacks.")
    ] = None,
) -> None:
    """Measure accuracy and speed beside KISS-ICP on the same scans, memory over a long drive, or the network."""
    from dpm2_core.evaluation.bench import BENCHES  # imports the whole SLAM
    from dpm2_core.evaluation.bench.harness import Options, write_report

    names = names or ["geometric"]
    if unknown := [name for name in names if name not in BENCHES]:
        raise UsageError(f"{unknown[0]}: no such benchmark; choose from {', '.join(BENCHES)}")
    options = Options(source or (), kitti, repetitions, threads, settings or (), weights, unseen, pairs, only, out)
    for name in names:
        report = BENCHES[name](options)
        path = out / f"{name}.json"
        write_report(path, name, report, options)
        Console().print(report.view, f"written to {path}")
