# SPDX-License-Identifier: Apache-2.0
"""Tables of `dpm2 bench neural`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType

from dpm2_core.tables import FigureTable


def view(parts: Mapping[str, Any]) -> Group:
    """Every part that was measured; what could not be is noted below its table."""
    shown: list[RenderableType] = []
    for name, title in (
        ("synthetic", "Unseen synthetic worlds"),
        ("corruption", "Failing sensors"),
        ("image", "Where the image must matter"),
        ("sensors", "Other LiDARs in unseen synthetic worlds"),
    ):
        if name in parts:
            shown.append(_pair_table(title, parts[name]["pairs"]))
            shown += [
                f"{key}: {text}" for key, text in parts[name].items() if isinstance(text, str) and key != "commit"
            ]
            if "error_ratio" in parts[name]:
                ratios = (f"{key} {ratio:.2f}" for key, ratio in parts[name]["error_ratio"].items())
                shown.append(f"median error over the clean one: {', '.join(ratios)}")
    for drive, kinds in parts.get("real", {}).get("drives", {}).items():
        shown.append(_pair_table(f"{drive}: pairs without a prior", kinds))
    for drive, methods in parts.get("odometry", {}).get("drives", {}).items():
        shown.append(_odometry_table(drive, methods))
    if "overlap" in parts:
        row = parts["overlap"]
        shown.append(
            f"Overlap head: average precision {row['average_precision']:.3f} on {row['pairs']} pairs, "
            f"{row['positive']} within 20 m, {row['negative_20_40_m']} at 20-40 m."
        )
    if "reference" in parts:
        shown.append(_reference_table(parts["reference"]["shares"]))
    for drive, row in parts.get("speed", {}).get("drives", {}).items():
        shown.append(_stage_table(drive, row))
        shown.append(f"Descriptors of a frame: {row['descriptor_bytes']} bytes.")
        if "with the camera" in row:
            shown.append(f"with the camera: {row['with the camera']}")
    return Group(*shown)


def _reference_table(shares: Mapping[str, Any]) -> FigureTable:
    kinds = next(iter(next(iter(shares.values())).values()))
    figures = [f"{within}, {apart}" for apart, row in kinds.items() for within in row if within != "pairs"]
    title = "Reference points that are near one of another frame, share"
    table = FigureTable(title, names=["drive", "chosen by"], figures=figures)
    for drive, rows in shares.items():
        for name, row in rows.items():
            values = [value for apart in row.values() for within, value in apart.items() if within != "pairs"]
            table.add_row(drive, name, *("-" if value is None else f"{value:.2f}" for value in values))
        table.add_section()
    return table


def _pair_table(title: str, kinds: Mapping[str, Any]) -> FigureTable:
    figures = ("pairs", "median m", "deg", "success %")
    table = FigureTable(f"{title}. Success: 0.6 m, 1.5 deg.", names=["kind", "method"], figures=figures)
    for kind, methods in kinds.items():
        for method, row in methods.items():
            values = (("median_m", 1, 3), ("median_deg", 1, 3), ("success", 100, 1))
            shown = ["-" if row[key] is None else f"{scale * row[key]:.{digits}f}" for key, scale, digits in values]
            table.add_row(kind, method, str(row["pairs"]), *shown)
        table.add_section()
    return table


def _odometry_table(drive: str, methods: Mapping[str, Any]) -> FigureTable:
    figures = ("RPE m", "deg", "APE m", "drift %", "failed", "ms", "p95", "ratio")
    table = FigureTable(f"{drive}: odometry. Ratio: of median times to KISS-ICP's.", names=["method"], figures=figures)
    for method, row in methods.items():
        keys = ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m", "final_drift_percent")
        errors = ["-" if row[key] is None else f"{row[key]:.3f}" for key in keys]
        ms = row["frame_ms"]
        times = [f"{ms['median']:.0f}", f"{ms['p95']:.0f}", f"{ms.get('ratio', float('nan')):.2f}"]
        table.add_row(method, *errors, f"{row['failed_frames']:.0f}", *times)
    return table


def _stage_table(drive: str, row: Mapping[str, Any]) -> FigureTable:
    ratio = f" Ratio of medians to KISS-ICP's: {row['ratio']:.2f}." if "ratio" in row else ""
    title = f"{drive}: encode and register, ms per frame.{ratio}"
    table = FigureTable(title, names=["stage"], figures=["median", "p95"])
    extra = {name: row[name] for name in ("without_camera_ms", "kiss-icp") if name in row}
    for stage, ms in {**row["stages_ms"], **extra}.items():
        table.add_row(stage, f"{ms['median']:.1f}", f"{ms['p95']:.1f}")
    return table
