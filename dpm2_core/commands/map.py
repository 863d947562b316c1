# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map`: look into map files, write them in other formats, join, thin out and mend them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from scipy.spatial.transform import Rotation

from dpm2_core.commands.map_graph import optimize
from dpm2_core.commands.map_info import MapFile, graph_of, info, say_what_is_missing, unplaced
from dpm2_core.commands.options import ConfigFile, Overrides, note
from dpm2_core.config import load_settings
from dpm2_core.console import Console
from dpm2_core.data.pcd import write_las, write_pcd
from dpm2_core.data.ply import write_ply
from dpm2_core.data.trajectory import write_kitti, write_tum
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import write_json
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.tiles import write_tiles
from dpm2_core.slam.store.map_data import MapData, check_new, load_map, map_cloud, save_as, trajectory, ways
from dpm2_core.slam.store.map_store import MapStore

if TYPE_CHECKING:
    from dpm2_core.slam.settings import SlamSettings

_OFF = 30.0  # m from where satellites have a map: receivers err by meters, and over its length so does a heading

app = typer.Typer(help="Map files: info, export, merge, prune, check; pose graphs: optimize.", no_args_is_help=True)
app.command()(info)
app.command()(optimize)


@app.command()
def export(
    path: MapFile,
    out: Annotated[Path, typer.Argument(help="File to write; its ending says what, unless --format does.")],
    format: Annotated[
        str,
        typer.Option(help="ply, pcd, las, html, occupancy (YAML and PGM for Nav2), tum, kitti, geojson or g2o."),
    ] = "",
    voxel: Annotated[
        float | None, typer.Option(min=0.01, max=1000, help="Spacing of the points of a cloud, m [0.3].")
    ] = None,
    resolution: Annotated[
        float | None, typer.Option(min=0.01, max=1000, help="Cell of the occupancy grid, m [0.1].")
    ] = None,
    tiles: Annotated[
        float | None,
        typer.Option(metavar="METERS", help="A folder of map files, one for each square, for `dpm2 run --localise`."),
    ] = None,
) -> None:
    """Write a map as a point cloud, a page for the browser, an occupancy grid, a trajectory, a pose graph, or tiles."""
    if tiles is not None:
        if format or voxel is not None or resolution is not None:
            raise UsageError("--tiles: squares of the map as it is; --format, --voxel and --resolution do not apply")
        with MapStore.open(path) as store:
            count = write_tiles(_tied(_loaded(store), out), out, tiles)
        note(f"{out} written: {count} tiles")
        return
    kind = format or _ENDINGS.get(out.suffix.lower(), "")
    if kind not in _EXPORTS:
        raise UsageError(f"{out}: choose --format from {', '.join(_EXPORTS)}")
    spacing = {"voxel": voxel, "resolution": resolution}
    write, requested = _EXPORTS[kind]
    if ignored := [name for name, value in spacing.items() if value is not None and name != requested]:
        raise UsageError(f"--{ignored[0]}: a map as {kind} has no use for it")
    if kind == "occupancy" and out.suffix not in (".yaml", ".pgm"):
        out = out.with_name(f"{out.name}.yaml")
    if out.exists() and out.samefile(path):
        raise UsageError(f"{out}: is the map itself")
    with MapStore.open(path) as store:
        write(_loaded(store), out, spacing.get(requested) or _SPACING[requested])
    note(f"{out} written")


@app.command()
def merge(
    paths: Annotated[list[Path], typer.Argument(metavar="MAP MAP...", help="Map files; the first one's frame stays.")],
    out: Annotated[Path, typer.Option(help="New map file.")],
    transform: Annotated[
        list[str] | None,
        typer.Option(
            help='Pose of a further map in the first: "x y z yaw" (m, deg) or "x y z qx qy qz qw"; one each. Else the '
            "maps are found in each other by their descriptors."
        ),
    ] = None,
    config: ConfigFile = None,
    settings: Overrides = None,
) -> None:
    """Join maps, by known transforms or by the places that they share."""
    from dpm2_core.network.pretrained import weights_id
    from dpm2_core.slam.mapping.merge import merge_maps, off_by_satellites, tie_of
    from dpm2_core.slam.settings import Config

    check_new(out)
    given = [parse_transform(text) for text in transform or ()]
    if len(paths) < 2 or (given and len(given) != len(paths) - 1):
        raise UsageError("merge: want two or more maps, and no --transform or one for each but the first")
    if given and (config is not None or settings):
        raise UsageError("merge: --config and --set say how places are found; known transforms need no settings")
    chosen = load_settings(Config, config, settings or ()).slam
    with ExitStack() as stack:
        maps = [load_map(stack.enter_context(MapStore.open(path)), descriptors=True) for path in paths]
        described = {session.weights for data in maps for session in data.sessions if session.weights}
        if not given:
            described.add(weights_id(chosen.neural.weights))
        if len(described) > 1:
            raise UsageError(f"merge: descriptors of several weights: {', '.join(sorted(described))}")
        named = list(zip(paths, maps, strict=True))
        _say_what_is_there_twice(named)
        first = maps[0] if given else _joined_by_places(named, chosen)
        for (path, other), T in zip(named[1:], given, strict=False):
            if (off := off_by_satellites(first, other, T)) > _OFF:
                doubt = f"{off:.0f} m from where the fixes of both maps have it: is its --transform right?"
                note(f"{path}: {doubt}")
            first = merge_maps(first, other, T, tie_of(first, other, T))
        save_as(first, out)
    note(f"{out}: {len(first)} keyframes")


def _say_what_is_there_twice(maps: list[tuple[Path, MapData]]) -> None:
    """Drives that several of the maps hold, as of a file that is named twice, or of two that were continued apart."""
    known = set[tuple[str, int, bytes]]()
    for path, data in maps:
        own = {(k.robot, k.stamp, k.T_odom_kf.tobytes()) for k in data.keyframes}
        if (count := len(own & known)) > 1:  # every drive of a simulator begins at the same time and pose
            said = f"{count} of its {len(data)} keyframes are in a map before it, too: they will be there twice"
            note(f"{path}: {said}")
        known |= own


def _joined_by_places(maps: list[tuple[Path, MapData]], settings: SlamSettings) -> MapData:
    """The first map with the others, in the order in which they share places with what is joined already.

    Raises:
        Dpm2Error: one shares none.
    """
    from dpm2_core.slam.build import make_loops
    from dpm2_core.slam.graph.pose_graph import PoseGraph
    from dpm2_core.slam.mapping.merge import align, loops_by, merge_maps, optimized

    (_, first), *waiting = maps
    while waiting:
        tried = (align(first, other, loops_by(make_loops(settings))) for _, other in waiting)
        number, found = next(((i, fit) for i, fit in enumerate(tried) if fit is not None), (0, None))
        if found is None:
            names = ", ".join(str(path) for path, _ in waiting)
            raise Dpm2Error(f"{names}: nothing of the other maps was found there; --transform says where they are")
        (path, other), (T, loops) = waiting.pop(number), found
        merged = merge_maps(first, other, T, loops)
        first = optimized(merged, PoseGraph(settings.pose_graph))
        note(f"{path}: {len(loops)} loops to what came before")
        checked = zip(merged.edges, first.edges, strict=True)
        if rejected := [f"{now.from_node} and {now.to_node}" for was, now in checked if was.ok and not now.ok]:
            said = "loops that contradict the rest are rejected, those of the new map's keyframes"
            note(f"{path}: {said} {', '.join(rejected)}")
    return first


@app.command()
def prune(
    path: MapFile,
    out: Annotated[Path, typer.Option(help="New map file.")],
    distance: Annotated[
        float, typer.Option(min=0, help="From an older keyframe, m; height counts four times; 0: only what borrows.")
    ] = 3.0,
    angle: Annotated[float, typer.Option(min=0, max=180, help="Between their headings, degrees.")] = 30.0,
) -> None:
    """Take out the keyframes that revisits made redundant; what they constrain and where they were stays."""
    from dpm2_core.slam.mapping.prune import prune as pruned
    from dpm2_core.slam.mapping.prune import redundant_nodes

    check_new(out)
    with MapStore.open(path) as store:
        data = load_map(store)
        less = pruned(data, redundant_nodes(data, distance, angle))
        save_as(less, out)
    note(f"{out}: {len(less)} keyframes of {len(data)}")


@app.command()
def check(
    path: MapFile,
    recover: Annotated[Path | None, typer.Option(help="Write what is good to this new map file.")] = None,
) -> None:
    """Look for damage: database, checksum of every row, dangling edges, invalid poses."""
    from dpm2_core.slam.mapping.parts import placed
    from dpm2_core.slam.store.check import check_map

    result = check_map(path, recover, placed)
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
        console.print(f"{path}: {result.keyframes} keyframes, sound")


def parse_transform(text: str) -> Array:
    """`x y z yaw` (m, degrees) or `x y z qx qy qz qw` to (4, 4).

    Raises:
        UsageError: it is neither.
    """
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
        if len(numbers) not in (4, 7) or not np.isfinite(numbers).all():
            raise ValueError
        angles = numbers[3:]
        R = Rotation.from_euler("z", angles[0], degrees=True) if len(angles) == 1 else Rotation.from_quat(angles)
    except ValueError:
        raise UsageError(f'--transform "{text}": want "x y z yaw" or "x y z qx qy qz qw"') from None
    return se3.make(R.as_matrix(), numbers[:3])


def _loaded(store: MapStore) -> MapData:
    """The map without descriptors.

    Raises:
        UsageError: it is empty.
    """
    say_what_is_missing(store)
    data = load_map(store, descriptors=False)
    if not len(data):
        raise UsageError(f"{store.path}: no keyframe in it yet")
    return data


def _tied(data: MapData, out: Path) -> MapData:
    """What is tied to the first keyframe; says what is not, and is left out of a file."""
    from dpm2_core.slam.mapping.parts import first_part

    tied = first_part(data)
    whole, left = (Counter({drive: len(poses) for drive, (_, poses) in ways(d).items()}) for d in (data, tied))
    for drive, count in sorted((whole - left).items()):
        _say_without(out, drive, count, whole[drive], "no loop ties them to the first keyframe")
    return tied


def _say_without(out: Path, drive: tuple[str, int], count: int, total: int, reason: str) -> None:
    """Say that keyframes of a drive (robot, session) are not in a file."""
    robot, session = drive
    name = f"session {session} of {robot}" if robot else f"session {session}"
    note(f"{out}: without {count} of the {total} keyframes of {name}: {reason}")


def _cloud(data: MapData, out: Path, voxel: float) -> Points:
    tied = _tied(data, out)
    return map_cloud(tied.clouds, tied.poses, voxel)


def _export_geojson(data: MapData, out: Path) -> None:
    from dpm2_core.geometry import geodesy
    from dpm2_core.slam.mapping.parts import placed_on_earth

    placed, features = placed_on_earth(data), []
    if np.isnan(placed.poses).all():
        raise UsageError(f"{out}: the map has no georeference; {unplaced(data) or 'see input.gnss_topic'}")
    for (robot, session), (_, poses) in ways(placed).items():
        way = poses[:, :3, 3]
        known = np.isfinite(way).all(axis=1)
        if not known.all():
            reason = "neither their own fixes nor those of what loops tie them to tell where they are"
            _say_without(out, (robot, session), int((~known).sum()), len(way), reason)
        if not known.any():
            continue
        line = [[round(lon, 9), round(lat, 9), round(up, 3)] for lat, lon, up in geodesy.geodetic(way[known]).tolist()]
        geometry = {"type": "LineString", "coordinates": line if len(line) > 1 else line * 2}
        features.append({"type": "Feature", "properties": {"robot": robot, "session": session}, "geometry": geometry})
    write_json(out, {"type": "FeatureCollection", "features": features})


def _export_page(data: MapData, out: Path, voxel: float) -> None:
    from dpm2_core.evaluation.map_page import write_map_page

    write_map_page(out, _tied(data, out), voxel)


def _export_occupancy(data: MapData, out: Path, resolution: float) -> None:
    from dpm2_core.slam.mapping.occupancy import ground_tilt, occupancy_grid, why_of_no_use, write_grid
    from dpm2_core.slam.mapping.occupancy_map import OccupancySettings

    tied = _tied(data, out)
    settings = OccupancySettings(resolution=resolution)
    write_grid(out, occupancy_grid(tied.clouds, tied.poses, settings, tied.clouds.origin))
    if (tilt := ground_tilt(tied.clouds, tied.poses, tied.clouds.origin)) > _STEEP:
        why = "as of a LiDAR mounted at an angle: an IMU, or its mounting in /tf_static, makes a level one"
        note(f"{out}: not to be used, the ground of the map is tilted by {tilt:.0f} degrees, {why}")
    if why := why_of_no_use(tied.poses):
        note(f"{out}: {why}")


_STEEP = 10.0  # degrees that the ground of a whole map may be tilted against the place where it begins
_SPACING = {"voxel": 0.3, "resolution": 0.1, "": 0.0}
"""Default of each option that is a spacing, m."""
_EXPORTS: dict[str, tuple[Callable[[MapData, Path, float], None], str]] = {
    "ply": (lambda data, out, voxel: write_ply(out, _cloud(data, out, voxel)), "voxel"),
    "pcd": (lambda data, out, voxel: write_pcd(out, _cloud(data, out, voxel)), "voxel"),
    "las": (lambda data, out, voxel: write_las(out, _cloud(data, out, voxel)), "voxel"),
    "html": (_export_page, "voxel"),
    "occupancy": (_export_occupancy, "resolution"),
    "tum": (lambda data, out, _: write_tum(out, *trajectory(_tied(data, out))), ""),
    "kitti": (lambda data, out, _: write_kitti(out, trajectory(_tied(data, out))[1]), ""),
    "geojson": (lambda data, out, _: _export_geojson(data, out), ""),
    "g2o": (lambda data, out, _: graph_of(data).write_g2o(out), ""),
}
"""How each kind is written, and the option that is its spacing."""
_ENDINGS = {
    ".ply": "ply", ".pcd": "pcd", ".las": "las", ".yaml": "occupancy", ".pgm": "occupancy", ".tum": "tum",
    ".g2o": "g2o", ".geojson": "geojson", ".html": "html",
}  # fmt: skip
