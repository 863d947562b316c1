# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map info`: what is in a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import JsonFile, show
from dpm2_core.tables import FigureTable

MapFile = Annotated[Path, typer.Argument(metavar="MAP", help="Map file, as `dpm2 run --map` writes it.")]


def info(path: MapFile, json_file: JsonFile = None) -> None:
    """What is in a map."""
    from dpm2_core.commands.map_figures import figures_of, georeference_text, say_what_is_missing, unplaced
    from dpm2_core.slam.store.map_data import load_map
    from dpm2_core.slam.store.map_store import MapStore

    with MapStore.open(path) as store:
        say_what_is_missing(store)
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
        ("extent", f"{extent} m, of the keyframes that are tied to the first" if extent else "-"),
        ("loops", f"{f['loops_accepted']} accepted of {f['loops_tried']} tried"),
        ("georeference", georeference_text(f["georeference"], unplaced(data))),
        ("size", f"{f['bytes'] / 1e6:.2f} MB, {f['bytes'] / max(f['keyframes'], 1) / 1e3:.1f} kB per keyframe"),
    )
    for row in rows:
        table.add_row(*row)
    for s in figures["sessions"]:
        tied = f", {s['untied']} of them not tied to the first keyframe: elsewhere" if s["untied"] else ""
        info = (
            f"{s['keyframes']} keyframes{tied}, {s['started']}, dpm2 {s['program']}, weights {s['weights'] or 'none'}"
        )
        table.add_row(f"session {s['session']}", info)
    show(table, figures, json_file)
