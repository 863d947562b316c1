# SPDX-License-Identifier: Apache-2.0
"""Tables of `dpm2 bench neural`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType

from dpm2_core.tables import FigureTable, record_table


def view(parts: Mapping[str, Any]) -> Group:
    """Tables of every measured part; what could not be measured is noted below its table."""
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
    columns = {f"{within}, {apart}": f"{{{apart}[{within}]:.2f}}"
               for apart, row in kinds.items() for within in row if within != "pairs"}  # fmt: skip
    title = "Share of reference points that are near one of another frame"
    return record_table(title, ["drive", "chosen by"], columns, shares, sections=True)


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
    columns = {
        "RPE m": "{rpe_trans_m:.3f}", "deg": "{rpe_rot_deg:.3f}", "APE m": "{ape_rmse_m:.3f}",
        "drift %": "{final_drift_percent:.3f}", "failed": "{failed_frames:.0f}", "ms": "{frame_ms[median]:.0f}",
        "p95": "{frame_ms[p95]:.0f}", "ratio": "{frame_ms[ratio]:.2f}",
    }  # fmt: skip
    return record_table(f"{drive}: odometry. Ratio: of median times to KISS-ICP's.", ["method"], columns, methods)


def _stage_table(drive: str, row: Mapping[str, Any]) -> FigureTable:
    ratio = f" Ratio of medians to KISS-ICP's: {row['ratio']:.2f}." if "ratio" in row else ""
    extra = {name: row[name] for name in ("without_camera_ms", "kiss-icp") if name in row}
    columns, stages = {"median": "{median:.1f}", "p95": "{p95:.1f}"}, {**row["stages_ms"], **extra}
    return record_table(f"{drive}: encode and register, ms per frame.{ratio}", ["stage"], columns, stages)
