# SPDX-License-Identifier: Apache-2.0
"""One or many runs on one HTML page: trajectories, loops, errors, times and states, without another file or network."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.data.trajectory import matched
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS, in_words, known
from dpm2_core.evaluation.metrics import align
from dpm2_core.evaluation.page import asset, escape, page
from dpm2_core.evaluation.run_folder import TRAJECTORY, RunFolder, read_run
from dpm2_core.frame import Array
from dpm2_core.tables import FigureTable, cells_of

_TIME_BINS = 300  # of the time along a drive
_KITTI = {"t_err %": "{t_err_percent:.3f}", "r_err deg/100 m": "{r_err_deg_per_100m:.3f}"}
_FIGURES = {
    "APE rmse m": "{ape_rmse_m:.3f}", "APE mean m": "{ape_mean_m:.3f}", "RPE m": "{rpe_trans_m:.4f}",
    "drift %": "{final_drift_percent:.3f}", "failed": "{failed_frames:d}", "breaks": "{breaks:d}",
    "frames/s": "{timing[fps]:.1f}",
}  # fmt: skip


def find_runs(folders: Sequence[Path]) -> list[tuple[str, Path]]:
    """Every run in or below the folders, once, with a unique name: the path of its folder below the given one, with
    more of the folders above if two runs would have the same name.

    Raises:
        UsageError: no such folder, or no run in it.
    """
    found = []
    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder")
        below = sorted(path.parent for path in folder.rglob(TRAJECTORY))
        if not below:
            raise UsageError(f"{folder}: no run in or below it; want {TRAJECTORY}, which `dpm2 run` writes")
        found += [(str(path.relative_to(folder)) if path != folder else folder.resolve().name, path) for path in below]
    runs = {path.resolve(): Path(name).parts for name, path in reversed(found)}
    while len(set(runs.values())) < len(runs):
        counts = Counter(runs.values())
        runs = {path: parts if counts[parts] == 1 else path.parts[-len(parts) - 1 :] for path, parts in runs.items()}
    return [("/".join(parts), path) for path, parts in reversed(runs.items())]


def runs_page(title: str, runs: Sequence[tuple[str, Path]], tables: Sequence[FigureTable] = ()) -> str:
    """The page of runs; those with the same truth are drawn in one frame.

    Raises:
        UsageError: a file of a run is damaged.
    """
    named_runs = [(name, read_run(path)) for name, path in runs]
    groups = _by_truth(named_runs)
    parts = [
        f"<h1>{escape(title)}</h1>",
        *(_table_html(table) for table in [*tables, *([_figures_table(named_runs)] if named_runs else [])]),
    ]
    if groups:
        parts.append('<div id="groups"></div><noscript>The drawings need JavaScript.</noscript>')
    return page(
        title,
        "\n".join(parts),
        style=asset("run_page.css"),
        script=asset("run_page.js") if groups else "",
        data=[_group_data(group) for group in groups] if groups else None,
    )


def _by_truth(runs: Sequence[tuple[str, RunFolder]]) -> list[list[tuple[str, RunFolder]]]:
    """Group the runs of the same drive; a run without ground truth is a group by itself."""

    def key(item: tuple[str, RunFolder]) -> str:
        name, run = item
        if run.truth is None:
            return f"1 {name}"
        first = run.truth.poses[[0, -1], :3, 3].round(2).tolist()
        return f"0 {run.truth.keys[0]:020d} {len(run.truth)} {first}"

    return [list(group) for _, group in groupby(sorted(runs, key=key), key)]


def _group_data(runs: Sequence[tuple[str, RunFolder]]) -> dict[str, Any]:
    truth = runs[0][1].truth
    truth_xy = [] if truth is None else _flat_xy(truth.poses[:, :3, 3])
    name = ", ".join(name for name, _ in runs) if len(runs) < 3 else f"{runs[0][0]} and {len(runs) - 1} more"
    return {"name": name, "truth": truth_xy, "runs": [_run_data(name, run) for name, run in runs]}


def _run_data(name: str, run: RunFolder) -> dict[str, Any]:
    T = aligned(run)
    positions = (T @ run.trajectory.poses)[:, :3, 3]
    ends = np.array([[loop.start, loop.end] for loop in run.loops]).reshape(-1, 2, 3) @ T[:3, :3].T + T[:3, 3]
    total = run.stages_ms.get("total", np.sum(list(run.stages_ms.values()), axis=0) if run.stages_ms else np.zeros(0))
    stages = {stage: round(float(times.mean()), 3) for stage, times in run.stages_ms.items() if len(times)}
    return {
        "name": name,
        "way": _flat_xy(positions),
        "loops": [
            [*np.round(end[:, :2].ravel(), 2).tolist(), loop.accepted, loop.reason]
            for end, loop in zip(ends, run.loops, strict=True)
        ],
        "states": [(state, len(list(group))) for state, group in groupby(run.states)],
        "stages": stages,
        "time": [
            round(float(part.mean()), 2)
            for part in np.array_split(total, max(1, min(_TIME_BINS, len(total))))
            if len(part)
        ],
        "byLength": _error_rows(run.metrics.get("per_length", ()), "length_m"),
        "bySpeed": _error_rows(run.metrics.get("per_speed", ()), "speed_mps"),
        "segments": _lengths_suffix(_lengths(run)),
    }


def aligned(run: RunFolder) -> Array:
    """T_truth_map (4, 4) of a run; the identity if too few poses match."""
    if run.truth is None or not len(run.trajectory):
        return np.eye(4)
    try:
        true, est, _ = matched(run.truth, run.trajectory)
    except UsageError:
        return np.eye(4)
    both = known(true) & known(est)
    return align(est[both, :3, 3], true[both, :3, 3]) if both.sum() > 1 else np.eye(4)


def _flat_xy(positions: Array) -> list[float]:
    """x, y of (N, 3) positions in sequence, rounded to the centimeter."""
    finite = positions[np.isfinite(positions).all(1), :2]
    found: list[float] = np.round(finite, 2).ravel().tolist()
    return found


def _error_rows(rows: Sequence[dict[str, Any]], key: str) -> list[list[float]]:
    names = (key, "t_err_percent", "r_err_deg_per_100m")
    return [[row[name] for name in names] for row in rows if all(row.get(name) is not None for name in names)]


def _figures_table(runs: Sequence[tuple[str, RunFolder]]) -> FigureTable:
    # The KITTI metric of other segments is another figure: each set of lengths has its own columns.
    measured = dict.fromkeys(_lengths(run) for _, run in runs if run.metrics.get("t_err_percent") is not None)
    kitti = sorted(measured, key=lambda lengths: lengths != OFFICIAL_LENGTHS) or [OFFICIAL_LENGTHS]
    headings = [name + _lengths_suffix(lengths) for lengths in kitti for name in _KITTI]
    caption = "APE after SE(3) alignment; RPE and KITTI metric unaligned; KITTI segments of 100 to 800 m if no other"
    table = FigureTable("Runs", names=["run"], figures=["frames", *headings, *_FIGURES, "loops", "rejected"],
                        caption=f"{caption} lengths are named.")  # fmt: skip
    for name, run in runs:
        errors = [
            cell
            for lengths in kitti
            for cell in cells_of(run.metrics if _lengths(run) == lengths else {}, _KITTI.values())
        ]
        figures = cells_of({**run.metrics, "timing": run.timing}, _FIGURES.values())
        accepted = sum(loop.accepted for loop in run.loops)
        table.add_row(name, str(len(run.trajectory)), *errors, *figures, str(accepted), str(len(run.loops) - accepted))
    return table


def _lengths(run: RunFolder) -> tuple[float, ...]:
    """Segment lengths of a run's KITTI metric, m."""
    return tuple(run.metrics.get("lengths_m") or OFFICIAL_LENGTHS)


def _lengths_suffix(lengths: Sequence[float]) -> str:
    return "" if lengths == OFFICIAL_LENGTHS else f" of {in_words(lengths)}"


def _table_html(table: FigureTable) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in table.headings)
    body = "".join(f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in row)}</tr>\n" for row in table.rows)
    caption = f"<p>{escape(table.caption)}</p>" if table.caption else ""
    title = escape(table.title)
    return f'<h2>{title}</h2><div class="wide"><table><tr>{head}</tr>\n{body}</table></div>{caption}'
