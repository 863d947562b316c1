# SPDX-License-Identifier: Apache-2.0
"""Drives of a fleet into one map, without any prior: places that look alike, loops that are affirmed, one graph.

What was found is kept in DIR/.merge, drive by drive and stretch by stretch: another drive costs what it touches.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import write_json
from dpm2_core.fleet.cluster import Cluster
from dpm2_core.fleet.drives import MAP
from dpm2_core.fleet.joins import ENOUGH, edge_from, join_part, stretches
from dpm2_core.fleet.part import Figures, Part, is_whole
from dpm2_core.fleet.places import FleetIndex, places_part, vectors_of
from dpm2_core.fleet.regions import LARGEST, Join, side_by_side, solve
from dpm2_core.fleet.run import View, do_parts
from dpm2_core.frame import Array, Keyframe
from dpm2_core.network.pretrained import weights_path
from dpm2_core.slam.loops.retrieval import Vector
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import MapData, load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.store.rows import unpack_descriptors, weights_id

_KEPT = ".merge"
_CANDIDATES = 8
"""Places that look alike, of each keyframe."""


@dataclass
class Merged:
    """What came out.

    Attributes:
        drives: that are in the map, with their keyframes.
        left_out: the others, with the reason.
        joins: of each two drives with a place in common: loops accepted and rejected.
        rejected: reasons, and how often.
    """

    drives: dict[str, int]
    left_out: dict[str, str]
    joins: list[dict[str, Any]] = field(default_factory=list)
    rejected: dict[str, int] = field(default_factory=dict)


def merge(folder: Path, out: Path, settings: SlamSettings, cluster: Cluster, view: View | None = None,
          largest: int = LARGEST) -> Merged:  # fmt: skip
    """Join the drives that `dpm2 fleet run` left in a folder, and write the map and OUT.json.

    Args:
        cluster: not entered yet. largest: keyframes of a region of the pose graph.

    Raises:
        UsageError: a map is there that is no merge of this folder, or no drive. Dpm2Error: nothing can be joined.
    """
    folder, view, left_out = folder.resolve(), view or View(), dict[str, str]()
    _check_place(out)
    kept = folder / _KEPT
    parts = dict(_drives(folder, left_out))
    if not parts:
        raise UsageError(f"{folder}: no drive that is whole; want the folder of `dpm2 fleet run`")
    with cluster:
        places = _places(parts, kept, settings, (cluster, view), left_out)
        joins = _joins(parts, places, kept, settings, (cluster, view))
    enough, refused = _affirmed(joins)
    with ExitStack() as stack:
        stores = {name: stack.enter_context(MapStore.open(folder / name / MAP)) for name in places}
        maps = {name: load_map(store, descriptors=False) for name, store in stores.items()}
        region = solve(maps, enough, settings.pose_graph, largest)
        enough, contradicted = _affirmed(region.joins)
        while contradicted and any(join.loop.ok for join in region.joins):  # what is left of them would hang on too few
            refused += contradicted
            region = solve(maps, enough, settings.pose_graph, largest)
            enough, contradicted = _affirmed(region.joins)
        refused += [join for join in region.joins if not join.loop.ok]
        together = _component(maps, enough)
        for name in maps:
            if name not in together:
                left_out[name] = f"no place in common with {together[0]}" if len(maps) > 1 else ""
        joined = [join for join in [*enough, *refused] if join.one in together and join.other in together]
        data = _one({name: maps[name] for name in together}, stores, region.poses, joined)
        _write(data, out)
    merged = _outcome({name: len(maps[name]) for name in together}, left_out, [*enough, *refused])
    write_json(out.with_name(f"{out.name}.json"), vars(merged))
    return merged


def _check_place(out: Path) -> None:
    """A map that this wrote may be replaced, any other file not."""
    record = out.with_name(f"{out.name}.json")
    try:
        own = "left_out" in json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        own = False
    if out.exists() and not own:
        raise UsageError(f"{out}: there is a file already, which is no merge of drives")


def _drives(folder: Path, left_out: dict[str, str]) -> Iterator[tuple[str, Part]]:
    """The part that reads the places of each drive that is whole, in the order of their names."""
    for path in sorted(folder.glob(f"*/{MAP}")):
        name = path.parent.name
        if is_whole(path.parent):
            yield name, places_part(name, path)
        else:
            left_out[name] = "not whole: it is being written, or was cut short"


def _places(parts: Mapping[str, Part], kept: Path, settings: SlamSettings, with_: tuple[Cluster, View],
            left_out: dict[str, str]) -> dict[str, Figures]:  # fmt: skip
    """What the drives' maps hold, of those that are sound and of the same weights."""
    own = weights_id(weights_path(settings.neural.weights))
    found: dict[str, Figures] = {}
    for name, outcome in zip(parts, do_parts(list(parts.values()), kept, *with_), strict=True):
        if outcome.figures is None:
            left_out[name] = outcome.reason or "stopped"
        elif outcome.figures["weights"] != [own]:
            left_out[name] = f"made with weights {', '.join(outcome.figures['weights'])}, not with {own}"
        else:
            found[name] = outcome.figures
    if not found:
        raise Dpm2Error("; ".join(f"{name}: {reason}" for name, reason in left_out.items()))
    return found


def _joins(parts: Mapping[str, Part], places: Mapping[str, Figures], kept: Path, settings: SlamSettings,
           with_: tuple[Cluster, View]) -> list[Join]:  # fmt: skip
    """Every loop that was tried between two drives. Candidates are found once for each drive, when it comes."""
    index = FleetIndex(kept)
    versions = {name: parts[name].arguments["version"] for name in places}
    if any(versions.get(name) != version for name, version, _ in index.drives):
        index.clear()  # a drive is gone, or another one by now
    slam = settings.model_dump(mode="json")
    maps = {name: dict(parts[name].arguments) for name in places}
    new = [name for name in places if name not in {known for known, *_ in index.drives}]
    for name in new:
        vectors = vectors_of(kept, parts[name])
        candidates = _candidates(index, vectors)
        write_json(kept / "candidates" / f"{name}.json", candidates)
        index.add(name, versions[name], vectors)
    if new:
        index.save()
    work, ends = [], []
    for name, *_ in index.drives:
        pairs = json.loads((kept / "candidates" / f"{name}.json").read_text(encoding="utf-8"))
        for one, rows in pairs.items():
            for number, stretch in enumerate(stretches(one, name, np.array(rows))):
                work.append(join_part(number, stretch, maps, slam))
                ends.append((one, name))
    outcomes = do_parts(work, kept, *with_)
    if failed := [outcome for outcome in outcomes if outcome.figures is None]:
        raise Dpm2Error(f"{len(failed)} of {len(work)} stretches failed: {failed[0].name}: {failed[0].reason}")
    found: dict[tuple[str, str, int, int], Join] = {}
    for (one, other), outcome in zip(ends, outcomes, strict=True):
        for figures in (outcome.figures or {})["loops"]:
            join = Join(one, other, edge_from(figures))
            key = one, other, join.loop.from_node, join.loop.to_node
            if key not in found or join.loop.ok:
                found[key] = join
    return list(found.values())


def _candidates(index: FleetIndex, vectors: Vector) -> dict[str, list[list[int]]]:
    """Of each drive in the index: node of it and node of the new drive, where they look alike."""
    begins = np.cumsum([0, *(count for *_, count in index.drives)])
    out: dict[str, list[list[int]]] = defaultdict(list)
    for node, found in enumerate(index.similar(vectors, _CANDIDATES)):
        for place in found[found >= 0].tolist():
            number = int(np.searchsorted(begins, place, side="right")) - 1
            out[index.drives[number][0]].append([int(place - begins[number]), node])
    return out


def _affirmed(joins: Sequence[Join]) -> tuple[list[Join], list[Join]]:
    """The accepted loops of drives that have enough of them; all others, with the reason."""
    by_pair: dict[tuple[str, str], list[Join]] = defaultdict(list)
    rejected = []
    for join in joins:
        if join.loop.ok:
            by_pair[join.one, join.other].append(join)
        else:
            rejected.append(join)
    enough: list[Join] = []
    for of_pair in by_pair.values():
        nodes = {join.loop.to_node for join in of_pair}
        if len(nodes) >= ENOUGH:
            enough += of_pair
        else:
            reason = f"only {len(nodes)} keyframes of the two drives agree, {ENOUGH} must"
            rejected += [replace(join, loop=join.loop.rejected(reason)) for join in of_pair]
    return enough, rejected


def _component(maps: Mapping[str, MapData], joins: Sequence[Join]) -> list[str]:
    """The drives that hang together and have the most keyframes, in their order."""
    part = {name: name for name in maps}
    for join in joins:
        one, other = part[join.one], part[join.other]
        part = {name: one if root == other else root for name, root in part.items()}
    sizes: dict[str, int] = defaultdict(int)
    for name, root in part.items():
        sizes[root] += len(maps[name])
    largest = max(sizes, key=lambda root: sizes[root])
    return [name for name in maps if part[name] == largest]


def _one(maps: Mapping[str, MapData], stores: Mapping[str, MapStore], poses: Mapping[str, Array],
         joins: Sequence[Join]) -> MapData:  # fmt: skip
    """The map of those drives; each is a robot by its name. Descriptors, too, are read when they are asked for."""
    renamed = {
        name: replace(
            data,
            keyframes=[replace(k, robot=f"{name}/{k.robot}".rstrip("/")) for k in data.keyframes],
            trail=[replace(p, robot=f"{name}/{p.robot}".rstrip("/")) for p in data.trail],
            poses=poses[name],
        )
        for name, data in maps.items()
    }
    data = side_by_side(renamed, joins)
    where = [(stores[name], node) for name in maps for node in range(len(maps[name]))]
    keyframes: Any = _Described(data.keyframes, where)
    return replace(data, keyframes=keyframes)


class _Described(Sequence[Keyframe]):
    """Keyframes with their descriptors, which are read from the drives' maps each time they are asked for."""

    def __init__(self, keyframes: Sequence[Keyframe], where: Sequence[tuple[MapStore, int]]) -> None:
        self._keyframes, self._where = keyframes, where

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, index: Any) -> Any:
        store, node = self._where[index]
        packed = store.payload(node, "descriptors")
        descriptors = None if packed is None else unpack_descriptors(packed)
        return replace(self._keyframes[index], descriptors=descriptors)


def _write(data: MapData, out: Path) -> None:
    """The map file, whole or not at all."""
    fresh = out.with_name(f".{out.name}.new")
    fresh.unlink(missing_ok=True)
    save_as(data, fresh)
    fresh.replace(out)


def _outcome(drives: dict[str, int], left_out: dict[str, str], joins: Sequence[Join]) -> Merged:
    pairs: dict[tuple[str, str], list[int]] = defaultdict(lambda: [0, 0])
    reasons: dict[str, int] = defaultdict(int)
    for join in joins:
        pairs[join.one, join.other][not join.loop.ok] += 1
        if not join.loop.ok:
            reasons["".join(c for c in join.loop.registration.reason if not c.isdigit())] += 1
    rows = [
        {"drives": list(pair), "accepted": accepted, "rejected": rejected}
        for pair, (accepted, rejected) in sorted(pairs.items())
    ]
    return Merged(drives, left_out, rows, dict(sorted(reasons.items(), key=lambda item: -item[1])))
