# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map optimize`: robust optimization of a pose graph of any program."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from dpm2_core.commands.options import JsonFile, show
from dpm2_core.console import Console
from dpm2_core.errors import Dpm2Error, UsageError, printable
from dpm2_core.tables import FigureTable


def optimize(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH.g2o", help="SE2 or SE3:QUAT; VERTEX lines may be missing.")],
    out: Annotated[Path, typer.Option(help="New g2o file: optimized vertices, odometry and the accepted loops.")],
    json_file: JsonFile = None,
) -> None:
    """Optimize a pose graph and reject the loops that cannot be true.

    --json also writes for each loop whether it was kept, and why.
    """
    from dpm2_core.slam.graph.calibrated import chi2_per_dof, optimize_calibrated, scaled
    from dpm2_core.slam.graph.g2o import read_g2o, require_connected, write_g2o
    from dpm2_core.slam.graph.graph_data import total_chi2, trajectories
    from dpm2_core.slam.graph.robust import least_squares

    if out.exists() and graph.exists() and out.samefile(graph):
        raise UsageError(f"{out}: is the input graph, and would lose its rejected loops; give another --out")
    file = read_g2o(graph)
    require_connected(graph, file)
    data, dof = file.graph, 3 if file.planar else 6
    began = time.perf_counter()
    try:
        with Console(stderr=True).status("") as status:
            result = optimize_calibrated(data, dof, status.update)
            solution, scale = result.solution, result.scale
            status.update("least squares")
            poses = least_squares(scaled(replace(data, poses=solution.poses), scale), solution.kept)
    except Dpm2Error as error:
        raise Dpm2Error(f"{graph}: {error}") from None
    seconds = time.perf_counter() - began
    optimized = replace(file, graph=replace(data, poses=poses))
    fit = chi2_per_dof(data, poses, solution.kept, dof)
    figures: dict[str, Any] = {
        "vertices": len(data),
        "trajectories": int(trajectories(data)[-1]) + 1,
        "edges": int(data.chained.sum()) + len(data.ends),
        "loops": len(data.ends),
        "kept": int(solution.kept.sum()),
        "rejected": int((~solution.kept).sum()),
        "chi2_before": total_chi2(data, data.poses),
        "chi2_after": total_chi2(data, poses, solution.kept),
        "chi2_per_dof": fit if math.isfinite(fit) else None,
        "covariance_scale": scale,
        "seconds": seconds,
    }
    write_g2o(out, optimized, solution.kept)
    verdicts = [
        {"from": int(a), "to": int(b), "kept": bool(kept), "reason": solution.reason(loop)}
        for loop, ((a, b), kept) in enumerate(zip(file.ids[data.ends], solution.kept, strict=True))
    ]
    warnings = _warnings(figures, solution.settled, result.undecided)
    record = {
        **figures,
        "settled": solution.settled,
        "ignored": file.ignored,
        "warnings": warnings,
        "verdicts": verdicts,
    }
    show(_table(graph, figures, file.ignored), record, json_file)
    for warning in warnings:
        print(printable(f"{graph}: {warning}"), file=sys.stderr)  # with --quiet too


def _warnings(figures: dict[str, Any], settled: bool, undecided: bool) -> list[str]:
    """Why the result may be wrong, in sentences."""
    scale, fit, out = figures["covariance_scale"], figures["chi2_per_dof"], []
    if not settled:
        out.append("the optimization has not converged; these are its last results")
    if figures["trajectories"] > max(1, 0.1 * figures["vertices"]):
        unconnected = f"{figures['trajectories'] - 1} of {figures['vertices']} vertices"
        out.append(f"{figures['trajectories']} trajectories: {unconnected} have no edge to the one before")
    if figures["kept"] < 0.5 * figures["loops"]:
        out.append(f"only {figures['kept']} of {figures['loops']} loops agree; the others were left out")
    if undecided:
        out.append(
            "the odometry's covariances are too large to detect a wrong loop, and the loops do not check each other:"
            " wrong ones may have been kept"
        )
    if fit is not None and fit > 2 * scale:  # about 0.5 if the kept loops fit
        out.append(
            f"the kept edges do not fit: chi2 is {fit / scale:.3g} per degree of freedom; are there wrong loops?"
        )
    if not 0.1 < scale < 10:
        size = f"{1 / scale:.3g} times too large" if scale < 1 else f"{scale:.3g} times too small"
        out.append(f"the covariances are {size} for the edges that agree; loops were judged by rescaled ones")
    return out


def _table(graph: Path, figures: dict[str, Any], ignored: dict[str, int]) -> FigureTable:
    table = FigureTable(str(graph), names=["what"], text=["value"], header=False)
    for name, value in figures.items():
        note = {"chi2_before": ", with every loop", "chi2_after": ", with the loops kept"}.get(name, "")
        text = f"{value:.4g}" if isinstance(value, float) and math.isfinite(value) else str(value)
        table.add_row(name.replace("_", " "), text + note)
    for tag, count in ignored.items():
        table.add_row("ignored", f"{count} lines {tag}")
    return table
