# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map`: show, export, merge, prune, check and repair map files; optimize pose graphs.

Modules that do the work are imported in the functions that need them, so that `--help` and shell completion are fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.map_graph import optimize
from dpm2_core.commands.options import ConfigFile, JsonFile, Overrides, note, show
from dpm2_core.console import Console
from dpm2_core.errors import Dpm2Error

app = typer.Typer(help="Map files: info, export, merge, prune, check; pose graphs: optimize.", no_args_is_help=True)
MapFile = Annotated[Path, typer.Argument(metavar="MAP", help="Map file, as `dpm2 run --map` writes it.")]


@app.command()
def info(path: MapFile, json_file: JsonFile = None) -> None:
    """Show what a map contains."""
    from dpm2_core.commands.map_figures import info_table

    show(*info_table(path), json_file)


app.command()(optimize)


@app.command()
def export(
    path: MapFile,
    out: Annotated[Path, typer.Argument(help="File to write; its extension determines the format without --format.")],
    format: Annotated[
        str,
        typer.Option(
            help="Format: ply, pcd, las, html, occupancy (YAML and PGM for Nav2), tum, kitti, geojson or g2o."
        ),
    ] = "",
    voxel: Annotated[
        float | None, typer.Option(min=0.01, max=1000, help="Spacing of the points of a cloud, m [0.3].")
    ] = None,
    resolution: Annotated[
        float | None, typer.Option(min=0.01, max=1000, help="Cell size of the occupancy grid, m [0.1].")
    ] = None,
    tiles: Annotated[
        float | None,
        typer.Option(
            metavar="METERS",
            help="Write a folder of map files instead, one for each square of this size, for `dpm2 run --localise`.",
        ),
    ] = None,
) -> None:
    """Write a map as a point cloud, a page for the browser, an occupancy grid, a trajectory, a pose graph, or tiles."""
    from dpm2_core.commands.map_export import export_map

    export_map(path, out, format, voxel, resolution, tiles)


@app.command()
def merge(
    paths: Annotated[list[Path], typer.Argument(metavar="MAP MAP...", help="Map files; the first one sets the frame.")],
    out: Annotated[Path, typer.Option(help="New map file.")],
    transform: Annotated[
        list[str] | None,
        typer.Option(
            help='Pose of another map in the frame of the first: "x y z yaw" (m, deg) or "x y z qx qy qz qw"; repeat '
            "it for each map but the first. Default: the maps are aligned by places that their descriptors recognize."
        ),
    ] = None,
    config: ConfigFile = None,
    settings: Overrides = None,
) -> None:
    """Join maps, by known transforms or by the places that they share."""
    from dpm2_core.commands.map_merge import merge_files

    merge_files(paths, out, transform, config, settings)


@app.command()
def prune(
    path: MapFile,
    out: Annotated[Path, typer.Option(help="New map file.")],
) -> None:
    """Remove the keyframes that revisits made redundant. Their constraints and their poses are kept.

    A keyframe is redundant if it is within 3 m (a meter of height counts as four) and 30 degrees of an older one.
    """
    from dpm2_core.slam.mapping.prune import prune as pruned
    from dpm2_core.slam.mapping.prune import redundant_nodes
    from dpm2_core.slam.mapping.redundancy import SAME, TURNED
    from dpm2_core.slam.store.map_data import load_map, save_as
    from dpm2_core.slam.store.map_file import check_new
    from dpm2_core.slam.store.map_store import MapStore

    check_new(out)
    with MapStore.open(path) as store:
        data = load_map(store, descriptors=False)
        pruned_data = pruned(data, redundant_nodes(data, SAME, TURNED))
        save_as(pruned_data, out)
    note(f"{out}: {len(pruned_data)} keyframes of {len(data)}")


@app.command()
def check(
    path: MapFile,
    recover: Annotated[Path | None, typer.Option(help="Write undamaged data to this new map file.")] = None,
) -> None:
    """Check a map for damage: database, checksum of every row, dangling edges, invalid poses."""
    from dpm2_core.slam.mapping.parts import georeferenced
    from dpm2_core.slam.store.check import check_map

    result = check_map(path, recover, georeferenced)
    console = Console(soft_wrap=True, highlight=False)
    for problem in result.problems:
        console.print(problem)
    if recover is not None:
        console.print(
            f"{recover}: {result.keyframes} keyframes, {result.lost} lost, {result.lost_clouds} without cloud"
        )
    elif result.problems:
        raise Dpm2Error(
            f"{path}: {len(result.problems)} problems, {result.keyframes} keyframes can be recovered with --recover OUT"
        )
    else:
        console.print(f"{path}: {result.keyframes} keyframes, no damage")
