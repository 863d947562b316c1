# SPDX-License-Identifier: Apache-2.0
"""Opens a map file for a drive: create, resume, extend, or localize only."""

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from dpm2_core.config import dump_settings
from dpm2_core.data.messages import returned
from dpm2_core.data.source import Source, frame_at
from dpm2_core.data.sweep_parts import may_be_part
from dpm2_core.data.time_order import frames_in_order
from dpm2_core.errors import UsageError
from dpm2_core.estimates import isotropic
from dpm2_core.frame import Frame, Points
from dpm2_core.network.pretrained import weights_id
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.mapping.tiles import TiledMap
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.slam.store.map_file import remove_map
from dpm2_core.slam.store.map_store import MapStore

MapMode = Literal["create", "resume", "extend", "localize"]
"""What to do with a map file: create it, continue an interrupted drive, add another drive, or only read it."""
_COMPARED_POINTS = 500  # points of a cloud
_MAX_DISTANCE = 0.75
"""m, 75th percentile of the distances: for the same frame 0.01, or the de-skewing; for another frame at least 1.1."""
_MAX_DISTANCE_OF_PART = 0.3  # m, the same for a part of a sweep: 0.09, and at least 0.4
_MAX_ANGLE = 0.02  # rad: a part of a sweep has points as close to the direction of its points in the cloud
_SAME_FRAME = isotropic(1e-4, 1e-3)  # rounding errors between two readings of the same frame


def open_map(path: Path, config: Config, mode: MapMode) -> MapStore | TiledMap:
    """The map file, opened as `mode` requires; see `open_session` and `open_for_localization`.

    Raises:
        UsageError: there is no map to extend.
    """
    if mode == "localize":
        return open_for_localization(path, config.slam)
    if mode == "extend" and not path.exists():
        raise UsageError(f"--extend: {path}: no such map file; without --extend this drive begins one")
    return open_session(path, config.slam, dump_settings(config), mode != "create")


def open_session(path: Path | str, settings: SlamSettings, config: str, resume: bool) -> MapStore:
    """Open the map file for writing, with a new session.

    Args:
        config: YAML, stored with the session.
        resume: continue the file, if there is one; else it must not exist.

    Raises:
        UsageError: the file exists, or has descriptors of other weights. Dpm2Error: it cannot be written.
    """
    path, weights = Path(path), settings.weights_id()
    if path.exists() and not resume:
        raise UsageError(
            f"--map {path}: there is a file already; --resume goes on with its drive, --extend adds another"
        )
    # Without `resume` no file was there above; if another node has made one since, `create` rejects it.
    exists = resume and path.exists()
    store = MapStore.open(path, read_only=False) if exists else MapStore.create(path)
    try:
        _check_weights(store, weights)
        store.begin_session(config, weights)
    except BaseException:
        store.close()
        if not exists:
            remove_map(path)
        raise
    return store


def open_for_localization(path: Path | str, settings: SlamSettings) -> MapStore | TiledMap:
    """The map file, or folder of tiles, for localization, open for reading only.

    Raises:
        UsageError: no map, no descriptors in it, or descriptors of other weights. Dpm2Error: it cannot be read.
    """
    path = Path(path)
    store = TiledMap(path) if path.is_dir() else MapStore.open(path)
    try:
        check_for_localization(store, settings)
    except BaseException:
        store.close()
        raise
    return store


def check_for_localization(store: MapStore | TiledMap, settings: SlamSettings) -> None:
    """Check that a map, which may still grow, can be used for localization.

    Raises:
        UsageError: it has no descriptors, or those of other weights. Dpm2Error: it cannot be read.
    """
    _check_weights(store, weights_id(settings.neural.weights))
    if not store.described:
        raise UsageError(f"{store.path}: no keyframe has descriptors (made with slam.loops.descriptors off?)")


def _check_weights(store: MapStore | TiledMap, weights: str) -> None:
    """Reject descriptors of different weights: they cannot be compared; `weights` "": none are made."""
    for used in store.weights if weights else ():
        if used and used != weights:
            raise UsageError(f"{store.path}: made with weights {used}, not with {weights}")


def resume_at(mapper: Mapper, source: Source, start: int) -> int:
    """Position of the map's last keyframe in the source, where the mapper continues; `start` for an empty map.

    Raises:
        UsageError: the frame of that keyframe is not in the source, or is a different frame with the same stamp.
    """
    if not mapper.keyframes:
        return start
    last = mapper.keyframes[-1]

    def index_at(position: int) -> int:
        return frame_at(source, position).index

    position = min(len(source) - 1, last.index - index_at(0))
    if position > 0 and index_at(position) != last.index:  # some scans are missing
        position = bisect_left(range(position), last.index, key=index_at)
    frames = () if position < 0 else frames_in_order(source, position, position + 1, lambda number, stamp: None)
    frame = next(iter(frames), None)
    if frame is None or frame.stamp != last.stamp:
        raise UsageError(f"--resume: frame {last.index}, where the map ends, is not in {source.name}")
    if not _is_cloud_of(frame, mapper.clouds[-1]):
        raise UsageError(f"--resume: frame {last.index} of {source.name} is not the one with which the map ends")
    mapper.start_session(None, _SAME_FRAME)
    return position


def _is_cloud_of(frame: Frame, cloud: Points) -> bool:
    """Whether a keyframe's cloud (M, 4) is of that frame. Stamps are not enough: all synthetic drives begin at 0."""
    points = frame.points[returned(frame.points)][:, :3]
    if not len(points) or not len(cloud):
        return True
    max_distance = _MAX_DISTANCE
    if may_be_part(frame):  # the cloud is of a whole sweep
        angles, _ = cKDTree(_directions(points)).query(_directions(cloud[:, :3]))
        cloud, max_distance = cloud[angles < _MAX_ANGLE], _MAX_DISTANCE_OF_PART
        if not len(cloud):
            return False
    distances, _ = cKDTree(points).query(cloud[:: -(-len(cloud) // _COMPARED_POINTS), :3])
    return bool(np.percentile(distances, 75) <= max_distance)


def _directions(points: Points) -> Points:
    """(N, 3) unit vectors."""
    return points / np.linalg.norm(points, axis=1, keepdims=True)
