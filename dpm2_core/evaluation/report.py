# SPDX-License-Identifier: Apache-2.0
"""Figures as printable tables, each row with its definition."""

from __future__ import annotations

import math

from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS, in_words
from dpm2_core.evaluation.metrics import Metrics
from dpm2_core.tables import FigureTable


def metrics_table(metrics: Metrics, title: str, frame: str, failed: str | None = None) -> FigureTable:
    """The figures, each row with its definition. `frame`: the sensor whose poses were compared. `failed`: what failed
    frames are, if no run has counted them and its breaks."""
    caption = f"Sensor frame: {frame}." + (f" Truth: {metrics.truth}." if metrics.truth else "")
    how_measured = ["how it is measured"]
    table = FigureTable(title, names=["figure"], figures=["value"], text=how_measured, caption=caption)
    t_err, r_err = metrics.t_err_percent, metrics.r_err_deg_per_100m
    kitti_note = (
        f"the path is shorter than {min(metrics.lengths_m):g} m; set shorter segments with `dpm2 eval --lengths`"
    )
    if t_err is not None and r_err is not None:
        start = "each 10th frame" if metrics.lengths_m == OFFICIAL_LENGTHS else "each frame"
        devkit = f"the development kit prints {t_err / 100:.6f} {math.radians(r_err / 100):.6f}"
        kitti_note = f"{metrics.segments} segments of {in_words(metrics.lengths_m)} from {start}, unaligned; {devkit}"
    states = f"{metrics.failed_frames} {failed or f'failed, {metrics.breaks} breaks'}"
    true_path = f"true path {_value(metrics.path_length_m, 'm')}"
    if metrics.compared is not None and metrics.compared < metrics.frames:
        true_path += f", {metrics.compared} poses compared"
    table.add_row("frames", str(metrics.frames), f"{states}; {true_path}")
    table.add_row("KITTI t_err", _value(t_err, "%"), kitti_note)
    table.add_row("KITTI r_err", _value(r_err, "deg/100 m"), "the same segments")
    for part in metrics.per_length if metrics.segments else ():
        values = f"{_value(part.r_err_deg_per_100m, 'deg/100 m')}, {part.segments} segments"
        table.add_row(f"  {part.length_m:g} m", _value(part.t_err_percent, "%"), values)
    table.add_row("APE rmse", _value(metrics.ape_rmse_m, "m"), "positions, SE(3) Umeyama alignment, no scale")
    table.add_row("RPE translation", _value(metrics.rpe_trans_m, "m"), "mean of frame to frame, unaligned")
    table.add_row("RPE rotation", _value(metrics.rpe_rot_deg, "deg"), "mean of frame to frame, unaligned")
    table.add_row("final drift", _value(metrics.final_drift_percent, "%"), "last position, aligned at the first pose")
    return table


def _value(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.4f} {unit}"
