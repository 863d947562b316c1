# SPDX-License-Identifier: Apache-2.0
"""`dpm2 fleet`: many drives on Ray, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import ConfigFile, JsonFile, Overrides, note, show
from dpm2_core.config import load_settings
from dpm2_core.console import Console
from dpm2_core.errors import Dpm2Error
from dpm2_core.fleet.cluster import Cluster
from dpm2_core.fleet.drives import parts_of, read_drives
from dpm2_core.fleet.part import Outcome, Part
from dpm2_core.fleet.run import SUMMARY, carry_out, summary_table
from dpm2_core.fleet.view import TerminalView
from dpm2_core.slam.settings import Config
from dpm2_core.tables import FigureTable

app = typer.Typer(help="Many drives, on this machine or on a cluster of Ray: run, merge, sweep.", no_args_is_help=True)

Drives = Annotated[
    list[Path],
    typer.Argument(metavar="DRIVE... | MANIFEST.yaml", help="Recordings, or a YAML list of them (docs/fleet.md)."),
]
Out = Annotated[
    Path, typer.Option(help="Folder for the results, which all workers can write to; complete results are kept.")
]
Address = Annotated[
    str | None,
    typer.Option("--ray", metavar="ADDRESS", help="Ray cluster, HOST:PORT or auto. Default: this machine."),
]
Workers = Annotated[
    int | None, typer.Option(min=1, show_default="as many as the processors allow", help="Parallel tasks, at most.")
]


@app.command()
def run(
    drives: Drives,
    out: Out,
    address: Address = None,
    workers: Workers = None,
    config: ConfigFile = None,
    settings: Overrides = None,
    json_file: JsonFile = None,
) -> None:
    """Run the SLAM on many drives. Each drive has its own folder with the files of `dpm2 run` and its map.

    Complete drives are not run again: the same call runs only those that were stopped or have failed.
    """
    parts = parts_of(read_drives(drives), config, settings or ())
    _carry_out(parts, out, Cluster(address, workers), json_file, partial(summary_table, str(out)))


@app.command()
def merge(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results of `dpm2 fleet run`.")],
    out: Annotated[
        Path, typer.Option(help="Map file; one of an earlier merge is replaced when the new one is complete.")
    ],
    address: Address = None,
    workers: Workers = None,
    config: ConfigFile = None,
    settings: Overrides = None,
    json_file: JsonFile = None,
) -> None:
    """Join the drives of a folder into one map by the places that they share. No initial poses are needed.

    Drives that are new since the last call are added to the existing map, at the cost of the part that they touch.
    """
    from dpm2_core.fleet.merge import merge as merged_map

    chosen = load_settings(Config, config, settings or ()).slam
    with TerminalView(Console(stderr=True)) as view:
        merged = merged_map(folder, out, chosen, Cluster(address, workers), view)
    table = FigureTable(str(out), names=["drives"], figures=["loops", "rejected"])
    for row in merged.joins:
        table.add_row(" - ".join(row["drives"]), str(row["accepted"]), str(row["rejected"]))
    show(table, {**asdict(merged), "rejected": merged.rejected}, json_file)
    for name, reason in merged.left_out.items():
        note(f"{name}: not in the map: {reason}", "yellow")
    total = len(merged.drives) + len(merged.left_out)
    note(f"{out}: {len(merged.drives)} of {total} drives, {sum(merged.drives.values())} keyframes")


@app.command()
def sweep(
    drives: Drives,
    out: Out,
    settings: Annotated[
        list[str],
        typer.Option("--set", help="Values to try, KEY=VALUE,VALUE,...; with several --set, every combination is run."),
    ],
    address: Address = None,
    workers: Workers = None,
    config: ConfigFile = None,
    json_file: JsonFile = None,
) -> None:
    """Run the same drives with each combination of settings, and show the figures in a table, a row per combination."""
    from dpm2_core.fleet.sweep import sweep_parts, sweep_table, variants

    values = variants(settings)
    parts = list(sweep_parts(read_drives(drives), config, values))
    _carry_out(parts, out, Cluster(address, workers), json_file, partial(sweep_table, str(out), list(values)))


def _carry_out(
    parts: list[Part],
    out: Path,
    cluster: Cluster,
    json_file: Path | None,
    table: Callable[[Sequence[Outcome]], FigureTable],
) -> None:
    """Run the parts and show their outcomes.

    Raises:
        Dpm2Error: one or more parts failed.
    """
    with TerminalView(Console(stderr=True)) as view:
        outcomes = carry_out(parts, out, cluster, view)
    show(table(outcomes), {"drives": [outcome._asdict() for outcome in outcomes]}, json_file)
    if any(outcome.state == "stopped" for outcome in outcomes):
        raise typer.Abort
    if failed := [outcome.name for outcome in outcomes if outcome.state == "failed"]:
        raise Dpm2Error(
            f"{len(failed)} of {len(outcomes)} failed: {', '.join(failed)}; {out / SUMMARY} has the reasons"
        )
