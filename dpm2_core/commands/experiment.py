# SPDX-License-Identifier: Apache-2.0
"""`dpm2 experiment`: the tables and figures of the papers, each made by one command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Group

from dpm2_core.commands.options import JsonFile, note, parse_lengths, parse_names, show
from dpm2_core.console import progress_bar
from dpm2_core.data.source import parse_range
from dpm2_core.errors import UsageError
from dpm2_core.tables import FigureTable


def experiment(
    name: Annotated[str | None, typer.Argument(help="Name of the experiment; --list shows all names.")] = None,
    data: Annotated[Path | None, typer.Argument(help="Root folder of the data set.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; finished parts in it are kept.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="List the experiments.")] = False,
    sequences: Annotated[
        str | None,
        typer.Option(help="Sequences to test on, separated by commas. Default: all of the paper's in the data set."),
    ] = None,
    learn: Annotated[
        str | None,
        typer.Option(help="Sequences to train on, separated by commas. Default: all of the paper's in the data set."),
    ] = None,
    weights: Annotated[
        str | None, typer.Option(help="Weights of the network: a shipped name or a .safetensors file.")
    ] = None,
    registration: Annotated[
        str | None,
        typer.Option(help="Registrations of the SLAM, separated by commas: geometric, neural, refined, adaptive."),
    ] = None,
    peer: Annotated[
        list[str] | None,
        typer.Option(
            help="Program to compare with: kiss-icp, kiss-slam, small_gicp, or its trajectories as NAME=FILE with "
            "{sequence} in the file name; repeat for more."
        ),
    ] = None,
    lengths: Annotated[
        str | None,
        typer.Option(help="Segment lengths of the KITTI metric, m, separated by commas, instead of 100 to 800."),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Frames a to b - 1 of each sequence, as a:b, counted from 0. Default: all.")
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Number of trainings of each compared network, one per seed.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file with settings of the trainings.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change a setting of the SLAM, or of the trainings: KEY=VALUE; repeat for more."),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Parallel parts, each in a process of its own.")] = 1,
    json_file: JsonFile = None,
) -> None:
    """Make a table or figure of the papers on your copy of the data, next to the papers' own figures.

    A stopped experiment continues where it was: every part (a method on a sequence, a training) is done only once.
    """
    from dpm2_core.experiments.registry import EXPERIMENTS, carry_out  # imports what --list needs, not torch
    from dpm2_core.experiments.request import Request
    from dpm2_core.experiments.table import shown
    from dpm2_core.fleet.part import Progress
    from dpm2_core.learning.begun import check_one_process

    if listed:
        table = FigureTable("Experiments", names=["name"], text=["of", "what"])
        for key, entry in EXPERIMENTS.items():
            table.add_row(key, entry.paper, entry.summary)
        show(table, {key: {"of": entry.paper, "what": entry.summary} for key, entry in EXPERIMENTS.items()}, json_file)
        return
    if name is None or data is None or out is None:
        raise UsageError("dpm2 experiment: give NAME DATA --out DIR, or --list")
    check_one_process("experiment")
    request = Request(
        data,
        out,
        sequences=parse_names(sequences),
        learn=parse_names(learn),
        weights=weights,
        registrations=parse_names(registration),
        peers=tuple(peer or ()),
        lengths=None if lengths is None else parse_lengths(lengths),
        frames=None if frames is None else parse_range(frames),
        seeds=seeds,
        config=config,
        overrides=tuple(settings or ()),
        workers=workers,
    )
    with progress_bar() as bar:
        part_task, frame_task = bar.add_task(name, total=None), bar.add_task("", total=None, visible=False)

        def frames_done(part: str, done: int, total: int) -> None:
            bar.update(frame_task, description=part, completed=done, total=total, visible=done < total)

        def part_done(part: str, done: int, total: int) -> None:
            bar.update(part_task, completed=done, total=total)
            bar.console.print(f"{part}: done", soft_wrap=True)

        findings = carry_out(name, request, Progress(frames_done, part_done))
    tables = [table_of.record() for table_of in findings.tables]
    show(Group(*map(shown, tables)), {"tables": tables, "notes": findings.notes}, json_file)
    for text in findings.notes:
        note(text, "yellow")
    note(f"Results in {out / name}.json and .html")
