# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map optimize`: a pose graph of any program, robustly."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from dpm2_core.console import Console
from dpm2_core.errors import Dpm2Error
from dpm2_core.files import atomic_write
from dpm2_core.tables import FigureTable


def optimize(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH.g2o", help="SE2 or SE3:QUAT; VERTEX lines may be absent.")],
    out: Annotated[Path, typer.Option(help="New g2o file: optimized vertices, odometry, the loops that were kept.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="The figures, and for each loop the result and why.")
    ] = None,
) -> None:
    """Optimize a pose graph and reject the loops that cannot be true."""
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
    except RuntimeError as error:  # gtsam's: the system is singular
        raise Dpm2Error(f"{graph}: {' '.join(str(error).split())}") from None
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
    if json_file is not None:
        verdicts = [
            {"from": int(a), "to": int(b), "kept": bool(kept), "reason": solution.reason(loop)}
            for loop, ((a, b), kept) in enumerate(zip(file.ids[data.ends], solution.kept, strict=True))
        ]
        record = {**figures, "settled": solution.settled, "ignored": file.ignored, "verdicts": verdicts}
        with atomic_write(json_file) as text:
            text.write(json.dumps(record, indent=1) + "\n")
    _show(graph, figures, file.ignored, solution.settled)


def _show(graph: Path, figures: dict[str, Any], ignored: dict[str, int], settled: bool) -> None:
    table = FigureTable(str(graph), names=["what"], text=["value"], header=False)
    for name, value in figures.items():
        note = {"chi2_before": ", with every loop", "chi2_after": ", with the loops kept"}.get(name, "")
        text = f"{value:.4g}" if isinstance(value, float) and np.isfinite(value) else str(value)
        table.add_row(name.replace("_", " "), text + note)
    for tag, count in ignored.items():
        table.add_row("ignored", f"{count} lines {tag}")
    if not settled:
        table.add_row("note", "the results had not come to rest; these are the last ones")
    Console().print(table)
