# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map export`: a map in other formats."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from dpm2_core.commands.map_figures import graph_of, note_missing_log, unplaced
from dpm2_core.commands.options import note
from dpm2_core.data.pcd import write_las, write_pcd
from dpm2_core.data.ply import write_ply
from dpm2_core.data.trajectory import write_kitti, write_tum
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.map_page import write_map_page
from dpm2_core.files import write_json
from dpm2_core.frame import Points
from dpm2_core.geometry import geodesy
from dpm2_core.slam.mapping.occupancy import ground_tilt, occupancy_grid, why_of_no_use, write_grid
from dpm2_core.slam.mapping.occupancy_map import OccupancySettings
from dpm2_core.slam.mapping.parts import first_part, placed_on_earth
from dpm2_core.slam.mapping.tiles import write_tiles
from dpm2_core.slam.store.map_cloud import map_cloud
from dpm2_core.slam.store.map_data import MapData, Way, load_map, trajectory, ways
from dpm2_core.slam.store.map_store import MapStore


def export_map(
    path: Path, out: Path, format: str, voxel: float | None, resolution: float | None, tiles: float | None
) -> None:
    """Write a map file in another format; the arguments are the options of the command.

    Raises:
        UsageError: options that exclude each other, or the map has no data of that kind.
    """
    if tiles is not None:
        if format or voxel is not None or resolution is not None:
            raise UsageError("--tiles: writes map files, to which --format, --voxel and --resolution do not apply")
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
        raise UsageError(f"--{ignored[0]}: does not apply to {kind}")
    if kind == "occupancy" and out.suffix not in (".yaml", ".pgm"):
        out = out.with_name(f"{out.name}.yaml")
    if out.exists() and out.samefile(path):
        raise UsageError(f"{out}: is the input map; choose another file")
    with MapStore.open(path) as store:
        write(_loaded(store), out, spacing.get(requested) or _SPACING[requested])
    note(f"{out} written")


def _loaded(store: MapStore) -> MapData:
    """The map without descriptors.

    Raises:
        UsageError: it is empty.
    """
    note_missing_log(store)
    data = load_map(store, descriptors=False)
    if not len(data):
        raise UsageError(f"{store.path}: the map has no keyframes")
    return data


def _tied(data: MapData, out: Path) -> MapData:
    """The part of a map that is tied to the first keyframe. Prints a note about keyframes that the file lacks."""
    tied = first_part(data)
    _say_without(out, ways(data), ways(tied), "no loop connects them to the first keyframe")
    return tied


def _say_without(out: Path, drives: Iterable[Way], written: Iterable[Way], reason: str) -> None:
    """Note, per session, how many keyframes of `drives` are missing in a file that contains those of `written`."""
    whole, left = Counter[tuple[str, int]](), Counter[tuple[str, int]]()
    for count, some in ((whole, drives), (left, written)):
        for way in some:
            count[way.robot, way.session] += len(way.poses)
    for (robot, session), missing in sorted((whole - left).items()):
        name = f"session {session} of {robot}" if robot else f"session {session}"
        note(f"{out}: {missing} of the {whole[robot, session]} keyframes of {name} are left out: {reason}")


def _cloud(data: MapData, out: Path, voxel: float) -> Points:
    tied = _tied(data, out)
    return map_cloud(tied.clouds, tied.poses, voxel)


def _export_geojson(data: MapData, out: Path) -> None:
    placed, features = placed_on_earth(data), []
    if np.isnan(placed.poses).all():
        raise UsageError(
            f"{out}: the map has no georeference: {unplaced(data) or 'no GNSS fixes; see input.gnss_topic'}"
        )
    drives = ways(placed)
    known = [replace(way, poses=way.poses[np.isfinite(way.poses).all(axis=(1, 2))]) for way in drives]
    reason = "neither their own fixes nor those of keyframes connected by loops give their position"
    _say_without(out, drives, known, reason)
    for way in (way for way in known if len(way.poses)):
        places = geodesy.geodetic(way.poses[:, :3, 3]).tolist()
        line = [[round(lon, 9), round(lat, 9), round(up, 3)] for lat, lon, up in places]
        geometry = {"type": "LineString", "coordinates": line if len(line) > 1 else line * 2}
        about = {"robot": way.robot, "session": way.session}
        features.append({"type": "Feature", "properties": about, "geometry": geometry})
    write_json(out, {"type": "FeatureCollection", "features": features})


def _export_occupancy(data: MapData, out: Path, resolution: float) -> None:
    tied = _tied(data, out)
    settings = OccupancySettings(resolution=resolution)
    write_grid(out, occupancy_grid(tied.clouds, tied.poses, settings))
    if (tilt := ground_tilt(tied.clouds, tied.poses)) > _STEEP:
        why = "as with a LiDAR mounted at an angle: use an IMU, or publish its mounting on /tf_static"
        note(f"{out}: do not use it: the ground of the map is tilted by {tilt:.0f} degrees, {why}")
    if why := why_of_no_use(tied.poses):
        note(f"{out}: {why}")


_STEEP = 10.0  # degrees: largest tilt of the ground of a whole map against the frame at its start
_SPACING = {"voxel": 0.3, "resolution": 0.1, "": 0.0}
"""Default of each option that is a spacing, m."""
_EXPORTS: dict[str, tuple[Callable[[MapData, Path, float], None], str]] = {
    "ply": (lambda data, out, voxel: write_ply(out, _cloud(data, out, voxel)), "voxel"),
    "pcd": (lambda data, out, voxel: write_pcd(out, _cloud(data, out, voxel)), "voxel"),
    "las": (lambda data, out, voxel: write_las(out, _cloud(data, out, voxel)), "voxel"),
    "html": (lambda data, out, voxel: write_map_page(out, _tied(data, out), voxel), "voxel"),
    "occupancy": (_export_occupancy, "resolution"),
    "tum": (lambda data, out, _: write_tum(out, *trajectory(_tied(data, out))), ""),
    "kitti": (lambda data, out, _: write_kitti(out, trajectory(_tied(data, out))[1]), ""),
    "geojson": (lambda data, out, _: _export_geojson(data, out), ""),
    "g2o": (lambda data, out, _: graph_of(data).write_g2o(out), ""),
}
"""Function that writes each kind, and the option for its spacing."""
_ENDINGS = {
    ".ply": "ply", ".pcd": "pcd", ".las": "las", ".yaml": "occupancy", ".pgm": "occupancy", ".tum": "tum",
    ".g2o": "g2o", ".geojson": "geojson", ".html": "html",
}  # fmt: skip
