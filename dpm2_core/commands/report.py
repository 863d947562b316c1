# SPDX-License-Identifier: Apache-2.0
"""`dpm2 report`: runs and experiments as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import note


def report(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of `dpm2 run` or `dpm2 experiment`, or their parents.")
    ],
    out: Annotated[Path, typer.Option(help="HTML file to write.")] = Path("report.html"),
) -> None:
    """Show runs on one page: trajectories, loops, errors by length and speed, times and states.

    Runs of one drive are drawn together. The page needs no network and no other file.
    """
    from dpm2_core.evaluation.run_folder import TRAJECTORY
    from dpm2_core.evaluation.run_page import find_runs, runs_page  # scipy is slow to import
    from dpm2_core.experiments.registry import tables_in
    from dpm2_core.files import atomic_write

    tables_of = {folder: tables_in(folder) for folder in folders}
    # Experiments on tasks only, and trainings without a run of the SLAM, write tables but no run.
    runs = find_runs([folder for folder in folders if any(folder.rglob(TRAJECTORY)) or not tables_of[folder]])
    tables = [table for found in tables_of.values() for table in found]
    text = runs_page(", ".join(folder.resolve().name for folder in folders), runs, tables)
    with atomic_write(out) as file:
        file.write(text)
    size = f"{len(text) / 1e6:.1f} MB" if len(text) >= 1e6 else f"{len(text) / 1e3:.0f} kB"
    note(f"{out}: {len(runs)} runs, {size}")
