# SPDX-License-Identifier: Apache-2.0
"""The parts of a fleet on a cluster: complete ones are kept, failed ones are named, and the rest continues."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from dpm2_core.files import make_folder, write_json
from dpm2_core.fleet.cluster import Cluster, Status
from dpm2_core.fleet.part import Outcome, Part, figures_of, remove_attempts
from dpm2_core.tables import FigureTable, cells_of

SUMMARY = "fleet.json"
"""The file in the folder of the results with the outcome of each drive."""


class View:
    """Display of the progress of a fleet; this one displays nothing."""

    def begun(self, names: Sequence[str]) -> None:
        """Called with the parts that are to be done."""

    def running(self, status: Mapping[str, Status]) -> None:
        """Called twice per second with the parts that have begun."""

    def ended(self, outcome: Outcome) -> None:
        """Called when a part is complete or has failed."""


def carry_out(parts: Sequence[Part], out: Path, cluster: Cluster, view: View | None = None) -> list[Outcome]:
    """Do all parts that are not complete yet and write OUT/fleet.json. Ctrl-C ends it early: the rest is "stopped", as
    it is in the file until the end.

    Args:
        cluster: not entered yet.

    Raises:
        UsageError: no Ray. Dpm2Error: the folder or the summary cannot be written.
    """
    out = out.resolve()  # a worker has another working directory
    make_folder(out)
    _write_summary(out, list(_initial_outcomes(parts, out).values()))
    with cluster:
        found = do_parts(parts, out, cluster, view or View())
    _write_summary(out, found)
    return found


def _write_summary(out: Path, outcomes: Sequence[Outcome]) -> None:
    write_json(out / SUMMARY, {"drives": [outcome._asdict() for outcome in outcomes]})


def not_done(out: Path) -> dict[str, str]:
    """Drives of the last request that were not done, with the reason: existing files of them are of other settings."""
    try:
        rows = json.loads((out / SUMMARY).read_text(encoding="utf-8"))["drives"]
        return {row["name"]: row["reason"] or row["state"] for row in rows if row["state"] in ("failed", "stopped")}
    except (OSError, ValueError, KeyError, TypeError):  # none, or damaged: nothing is known
        return {}


def do_parts(parts: Sequence[Part], out: Path, cluster: Cluster, view: View) -> list[Outcome]:
    """The outcome of each part, in their order; Ray is started only if there is something to do.

    Args:
        out: absolute.
    """
    outcomes = _initial_outcomes(parts, out)
    missing = [part for part in parts if outcomes[part.name].state == "stopped"]
    view.begun([part.name for part in missing])
    try:
        for outcome in cluster.run(missing, out, view.running):
            outcomes[outcome.name] = outcome
            view.ended(outcome)
    except KeyboardInterrupt:
        pass
    finally:
        for part in missing:
            remove_attempts(part, out)
    return list(outcomes.values())


def _initial_outcomes(parts: Sequence[Part], out: Path) -> dict[str, Outcome]:
    """The outcome of each part before anything is done: complete ones are kept."""
    found = {part.name: figures_of(part, out) for part in parts}
    return {name: Outcome(name, "stopped" if row is None else "kept", row) for name, row in found.items()}


def summary_table(title: str, outcomes: Sequence[Outcome]) -> FigureTable:
    """A row for each drive, those that failed last."""
    columns = {
        "frames": "{frames}", "keyframes": "{keyframes}", "loops": "{loops[accepted]}", "breaks": "{breaks}",
        "t_err %": "{metrics[t_err_percent]:.2f}", "APE m": "{metrics[ape_rmse_m]:.2f}", "s": "{part[seconds]:.0f}",
        "MB": "{part[peak_memory_mb]}",
    }  # fmt: skip
    table = FigureTable(title, names=["drive", "state"], figures=list(columns), text=["notes"])
    for outcome in sorted(outcomes, key=lambda outcome: outcome.state in ("failed", "stopped")):
        cells = cells_of(outcome.figures or {}, columns.values())
        table.add_row(outcome.name, outcome.state, *cells, outcome.reason)
    return table
