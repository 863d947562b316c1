# SPDX-License-Identifier: Apache-2.0
"""Content of a map: the figures of `dpm2 map info`, its pose graph, and what is missing in its file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.commands.options import note
from dpm2_core.database import size_with_log
from dpm2_core.evaluation.metrics import path_length
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.parts import placed
from dpm2_core.slam.mapping.restore import restore_solved
from dpm2_core.slam.store.map_data import MapData, load_map, ways
from dpm2_core.slam.store.map_file import missing_log
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.tables import FigureTable


def note_missing_log(store: MapStore) -> None:
    """Print a note if the last keyframes of a map may be in a file that is no longer next to it."""
    if missing := missing_log(store.path):
        note(f"{store.path}: {missing}")


def info_table(path: Path) -> tuple[FigureTable, dict[str, Any]]:
    """Content of a map, as a table and as figures."""
    with MapStore.open(path) as store:
        note_missing_log(store)
        data = load_map(store, descriptors=False)
        figures = figures_of(path, data, sum(row[0] or 0 for row in store.rows("payloads", "descriptors IS NOT NULL")))
    f = figures
    table = FigureTable(str(path), names=["what"], text=["value"], header=False)
    own = f"{f['own_clouds']} of them with their own cloud, {f['with_descriptors']} with descriptors"
    extent = " x ".join(f"{size:.1f}" for size in f["extent_m"])
    rows = (
        ("keyframes", f"{f['keyframes']}, {own}"),
        ("pruned", str(f["pruned"])),
        ("robots", ", ".join(robot or "(one)" for robot in f["robots"]) or "-"),
        ("length", f"{f['length_m']:.1f} m"),
        ("extent", f"{extent} m, of the keyframes that are connected to the first" if extent else "-"),
        ("loops", f"{f['loops_accepted']} accepted of {f['loops_tried']} tried"),
        ("georeference", georeference_text(f["georeference"], unplaced(data))),
        ("size", f"{f['bytes'] / 1e6:.2f} MB, {f['bytes'] / max(f['keyframes'], 1) / 1e3:.1f} kB per keyframe"),
    )
    for row in rows:
        table.add_row(*row)
    for s in figures["sessions"]:
        untied = (
            f", {s['untied']} of them not connected to the first keyframe: their poses are not known"
            if s["untied"]
            else ""
        )
        info = (
            f"{s['keyframes']} keyframes{untied}, {s['started']}, dpm2 {s['program']}, weights {s['weights'] or 'none'}"
        )
        table.add_row(f"session {s['session']}", info)
    return table, figures


def figures_of(path: Path, data: MapData, with_descriptors: int) -> dict[str, Any]:
    loops, drives = [edge for edge in data.edges if edge.kind == "loop"], ways(data)
    connected, session = placed(data), np.array([k.session for k in data.keyframes], np.int64)
    return {
        "map": str(path),
        "keyframes": len(data),
        "own_clouds": int(data.clouds.kept.sum()),
        "with_descriptors": with_descriptors,
        "with_fix": sum(keyframe.fix is not None for keyframe in data.keyframes),
        "pruned": len(data.trail),
        "robots": sorted({drive.robot for drive in drives}),
        "length_m": sum(path_length(drive.poses) for drive in drives),
        "extent_m": np.ptp(data.poses[connected, :3, 3], axis=0).tolist() if len(data) else [],
        "loops_accepted": sum(edge.ok for edge in loops),
        "loops_tried": len(loops),
        "georeference": _georeference_figures(data),
        "bytes": size_with_log(path),
        "sessions": [
            {
                "session": s.number,
                "keyframes": int((session == s.number).sum()),
                "untied": int(((session == s.number) & ~connected).sum()),
                "started": s.started,
                "program": s.program,
                "weights": s.weights,
            }
            for s in data.sessions
        ],
    }


def _georeference_figures(data: MapData) -> dict[str, Any] | None:
    """Pose of the map on Earth, with standard deviations; None if it is not known.

    The covariance is that of the whole graph, which is built for it: 0.8 s for 2,000 keyframes with a fix each. It is
    not stored in the file, where it would have to be updated with every keyframe.
    """
    if data.georeference is None:
        return None
    graph = graph_of(data)
    covariance, (used, count) = graph.georeference_covariance(), graph.fixes
    T, sigmas = data.georeference.T_enu_map, None if covariance is None else np.sqrt(np.diag(covariance))
    return {
        "origin": data.georeference.origin.tolist(),
        "T_enu_map": T.tolist(),
        "heading_deg": float(np.degrees(np.arctan2(T[1, 0], T[0, 0]))),
        "heading_sigma_deg": None if sigmas is None else float(np.degrees(sigmas[2])),
        "position_sigma_m": None if sigmas is None else sigmas[3:].tolist(),
        "fixes_used": used,
        "fixes": count,
    }


def unplaced(data: MapData) -> str:
    """Why a map has no georeference, in words; empty if it has no fixes."""
    fixes = np.array([keyframe.fix is not None for keyframe in data.keyframes], np.bool_)
    connected = int(fixes[placed(data)].sum())
    unconnected = int(fixes.sum()) - connected
    why = "the trajectory is too short or too straight, or at least half of them are off it, as with another clock"
    reasons = [f"{connected} fixes do not determine it: {why}"] if connected else []
    if unconnected:
        reasons.append(f"{unconnected} fixes are of keyframes that no loop connects to the first")
    return "; ".join(reasons)


def georeference_text(figures: dict[str, Any] | None, unplaced: str) -> str:
    if figures is None:
        return f"- ({unplaced})" if unplaced else "-"
    latitude, longitude, altitude = figures["origin"]
    heading = f"{figures['heading_deg']:.2f} deg from east to north"
    where = f"origin {latitude:.8f}, {longitude:.8f}, {altitude:.2f} m; map's x axis {heading}"
    if figures["position_sigma_m"] is None:
        return f"{where}; its accuracy is not known: too few fixes are connected to the first keyframe"
    east, north, up = figures["position_sigma_m"]
    return (
        f"{where} (sigma {figures['heading_sigma_deg']:.2f}); sigma {east:.2f}, {north:.2f}, {up:.2f} m; "
        f"{figures['fixes_used']} of {figures['fixes']} fixes used"
    )


def graph_of(data: MapData) -> PoseGraph:
    """The pose graph of a map, with its stored poses."""
    graph = PoseGraph(RobustSettings())
    restore_solved(graph, data)
    return graph
