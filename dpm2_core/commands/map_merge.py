# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map merge`: join several maps into one."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dpm2_core.commands.options import note
from dpm2_core.config import load_settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.network.pretrained import weights_id
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.mapping.merge import align, loops_by, merge_maps, off_by_satellites, optimized, tie_of
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.slam.store.map_data import MapData, load_map, save_as
from dpm2_core.slam.store.map_file import check_new
from dpm2_core.slam.store.map_store import MapStore

# m from the GNSS position of a map: fixes err by meters, and so does its heading over its length.
_MAX_FIX_DISTANCE = 30.0


def merge_files(
    paths: list[Path],
    out: Path,
    transform: Sequence[str] | None,
    config: Path | None,
    settings: Sequence[str] | None,
) -> None:
    """Join map files; the arguments are the options of the command.

    Raises:
        UsageError: options that exclude each other, or descriptors of several weights. Dpm2Error: a map shares no place
            with the others.
    """
    check_new(out)
    transforms = [parse_transform(text) for text in transform or ()]
    if len(paths) < 2 or (transforms and len(transforms) != len(paths) - 1):
        raise UsageError("merge: want two or more maps, and either no --transform or one for each map but the first")
    if transforms and (config is not None or settings):
        raise UsageError("merge: --config and --set are for finding places, and do not apply with --transform")
    chosen = load_settings(Config, config, settings or ()).slam
    with ExitStack() as stack:
        maps = [load_map(stack.enter_context(MapStore.open(path)), descriptors=not transforms) for path in paths]
        weights_ids = {session.weights for data in maps for session in data.sessions if session.weights}
        if not transforms:
            weights_ids.add(weights_id(chosen.neural.weights))
        if len(weights_ids) > 1:
            raise UsageError(f"merge: descriptors of several weights: {', '.join(sorted(weights_ids))}")
        named = list(zip(paths, maps, strict=True))
        _note_duplicate_keyframes(named)
        first = maps[0] if transforms else _join_by_places(named, chosen)
        for (path, other), T in zip(named[1:], transforms, strict=False):
            if (distance := off_by_satellites(first, other, T)) > _MAX_FIX_DISTANCE:
                text = f"{distance:.0f} m from its pose by the fixes of both maps: is its --transform right?"
                note(f"{path}: {text}")
            first = merge_maps(first, other, T, tie_of(first, other, T))
        save_as(first, out)
    note(f"{out}: {len(first)} keyframes")


def _note_duplicate_keyframes(maps: list[tuple[Path, MapData]]) -> None:
    """Note keyframes that several maps contain: a file is given twice, or copies of a map were extended separately."""
    known = set[tuple[str, int, bytes]]()
    for path, data in maps:
        keys = {(k.robot, k.stamp, k.T_odom_kf.tobytes()) for k in data.keyframes}
        if (count := len(keys & known)) > 1:  # every drive of a simulator begins at the same time and pose
            text = f"{count} of its {len(data)} keyframes are also in an earlier map: they will be in the new map twice"
            note(f"{path}: {text}")
        known |= keys


def _join_by_places(maps: list[tuple[Path, MapData]], settings: SlamSettings) -> MapData:
    """Join the other maps to the first one. The next map is always one that shares places with those joined before.

    Raises:
        Dpm2Error: a map shares no place with them.
    """
    from dpm2_core.slam.build import make_loops

    (_, first), *remaining = maps
    while remaining:
        tried = (align(first, other, loops_by(make_loops(settings))) for _, other in remaining)
        number, found = next(((i, fit) for i, fit in enumerate(tried) if fit is not None), (0, None))
        if found is None:
            names = ", ".join(str(path) for path, _ in remaining)
            raise Dpm2Error(f"{names}: no place of the other maps was found there; give their poses by --transform")
        (path, other), (T, loops) = remaining.pop(number), found
        merged = merge_maps(first, other, T, loops)
        first = optimized(merged, PoseGraph(settings.pose_graph))
        note(f"{path}: {len(loops)} loops to the maps before")
        edge_pairs = zip(merged.edges, first.edges, strict=True)
        if rejected := [
            f"{after.from_node} and {after.to_node}" for before, after in edge_pairs if before.ok and not after.ok
        ]:
            text = "loops that contradict the others are rejected, between the new map's keyframes"
            note(f"{path}: {text} {', '.join(rejected)}")
    return first


def parse_transform(text: str) -> Array:
    """`x y z yaw` (m, degrees) or `x y z qx qy qz qw` to (4, 4).

    Raises:
        UsageError: the text is neither.
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
