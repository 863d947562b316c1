# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map optimize`: a pose graph of any program, robustly."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from dpm2_core.commands.options import JsonFile, show
from dpm2_core.errors import Dpm2Error
from dpm2_core.tables import FigureTable


def optimize(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH.g2o", help="SE2 or SE3:QUAT; VERTEX lines may be absent.")],
    out: Annotated[Path, typer.Option(help="New g2o file: optimized vertices, odometry, the loops that were kept.")],
    json_file: JsonFile = None,
) -> None:
    """Optimize a pose graph and reject the loops that cannot be true.

    --json has the result for each loop, and why.
    """
    from dpm2_core.slam.graph.g2o import read_g2o, require_connected, write_g2o
    from dpm2_core.slam.graph.graph_data import total_chi2
    from dpm2_core.slam.graph.robust import RobustSettings, least_squares, optimize

    file = read_g2o(graph)
    require_connected(graph, file)
    data = file.graph
    began = time.perf_counter()
    try:
        solution = optimize(data, RobustSettings())
        poses = least_squares(replace(data, poses=solution.poses), solution.kept)
    except Dpm2Error as error:
        raise Dpm2Error(f"{graph}: {error}") from None
    seconds = time.perf_counter() - began
    optimized = replace(file, graph=replace(data, poses=poses))
    figures: dict[str, Any] = {
        "vertices": len(data),
        "edges": int(data.chained.sum()) + len(data.ends),
        "loops": len(data.ends),
        "kept": int(solution.kept.sum()),
        "rejected": int((~solution.kept).sum()),
        "chi2_before": total_chi2(data, data.poses),
        "chi2_after": total_chi2(data, poses, solution.kept),
        "seconds": seconds,
    }
    write_g2o(out, optimized, solution.kept)
    verdicts = [
        {"from": int(a), "to": int(b), "kept": bool(kept), "reason": solution.reason(loop)}
        for loop, ((a, b), kept) in enumerate(zip(file.ids[data.ends], solution.kept, strict=True))
    ]
    record = {**figures, "settled": solution.settled, "ignored": file.ignored, "verdicts": verdicts}
    show(_table(graph, figures, file.ignored, solution.settled), record, json_file)


def _table(graph: Path, figures: dict[str, Any], ignored: dict[str, int], settled: bool) -> FigureTable:
    table = FigureTable(str(graph), names=["what"], text=["value"], header=False)
    for name, value in figures.items():
        note = {"chi2_before": ", with every loop", "chi2_after": ", with the loops kept"}.get(name, "")
        text = f"{value:.4g}" if isinstance(value, float) and np.isfinite(value) else str(value)
        table.add_row(name.replace("_", " "), text + note)
    for tag, count in ignored.items():
        table.add_row("ignored", f"{count} lines {tag}")
    if not settled:
        table.add_row("note", "the results had not come to rest; these are the last ones")
    return table
