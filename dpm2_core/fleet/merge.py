# SPDX-License-Identifier: Apache-2.0
"""Merge drives of a fleet into one map, without initial poses: places that look alike, confirmed loops, one graph.

An existing map grows by the new drives; it is made again only if it no longer holds.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import named, part_beside, write_json
from dpm2_core.fleet.cluster import Cluster
from dpm2_core.fleet.drives import MAP
from dpm2_core.fleet.growth import Growth, Standing, add_drives, grown, joins_of
from dpm2_core.fleet.joins import ENOUGH
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.fleet.regions import LARGEST, Join, solve
from dpm2_core.fleet.run import View
from dpm2_core.fleet.search import Search, accepted_and_rejected, component
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import MapData, load_map
from dpm2_core.slam.store.map_file import check_new, move_map, remove_map
from dpm2_core.slam.store.map_store import MapStore


@dataclass
class Merged:
    """The result of a merge.

    Attributes:
        drives: in the map, with their number of keyframes, in the order of the file.
        left_out: the others, with the reason.
        joins: of each two drives with a place in common: loops accepted and rejected, and why.
        made: its inputs; a map that was made from other inputs does not grow, but is made again.
    """

    drives: dict[str, int]
    left_out: dict[str, str]
    joins: list[dict[str, Any]] = field(default_factory=list)
    made: dict[str, Any] = field(default_factory=dict)

    @property
    def rejected(self) -> dict[str, int]:
        """Reasons why loops were rejected, and their numbers."""
        total = sum((Counter(row["reasons"]) for row in self.joins), Counter[str]())
        return dict(total.most_common())


def merge(folder: Path, out: Path, settings: SlamSettings, cluster: Cluster, view: View | None = None,
          largest: int = LARGEST) -> Merged:  # fmt: skip
    """Join the drives that `dpm2 fleet run` wrote to a folder, and write the map and OUT.json.

    Args:
        cluster: not entered yet. largest: most keyframes of a region of the pose graph.

    Raises:
        UsageError: a file exists that is no merge of drives or contains more than these, or the log of a map that was
            moved; or there is no drive.
        Dpm2Error: nothing can be joined, or the existing map is damaged.
        KeyboardInterrupt: it was stopped before all drives were examined; the map stays as it is.
    """
    folder, left_out = folder.resolve(), dict[str, str]()
    previous = _read_record(out, folder)
    with cluster:
        search = Search(folder, settings, cluster, view or View())
        parts = search.drives(left_out)
        if not parts:
            raise UsageError(f"{folder}: no complete drive in it; want the folder of `dpm2 fleet run`")
        places = search.places(parts, left_out)
        parts = {name: parts[name] for name in places}
        index = search.index(parts)
        inputs = _map_inputs(folder, settings, parts)
        merged = None
        if previous is not None and _is_up_to_date(previous, out, inputs):
            joins = search.joins(parts, index, previous.drives)
            merged = _extend_map(previous, out, search, _keyframe_counts(places), joins, largest)
        if merged is None:
            merged = _build_map(out, search, _keyframe_counts(places), search.joins(parts, index), largest)
        unconnected = [name for name in places if name not in merged.drives]
        merged.left_out |= left_out | {
            name: f"no place in common with {next(iter(merged.drives))}" for name in unconnected
        }
        merged.made = {**inputs, "versions": {name: inputs["versions"][name] for name in merged.drives}}
        write_json(_record_path(out), asdict(merged))  # before Ray ends, which takes seconds
    return merged


def _record_path(out: Path) -> Path:
    return out.with_name(f"{out.name}.json")


def _read_record(out: Path, folder: Path) -> Merged | None:
    """The record of the existing map. Only a map that a merge wrote may be changed, no other file."""
    try:
        merged = TypeAdapter(Merged).validate_json(_record_path(out).read_bytes())
    except (OSError, ValueError):
        merged = None
    if not out.exists():
        check_new(out)  # the log of another map that was moved without it must not be removed
        return merged
    if merged is None:
        raise UsageError(f"{out}: the file exists, and is no merge of drives")
    drives = merged.drives.keys() | {path.parent.name for path in folder.glob(f"*/{MAP}")}
    with MapStore.open(out) as store:
        others = sum(str(robot).partition("/")[0] not in drives for (robot,) in store.rows("keyframes", "robot"))
    if others:  # by `dpm2 run --extend`, or another program's file next to an old record
        raise UsageError(f"{out}: {others} of its keyframes are of no drive in {folder}; choose another --out")
    return merged


def _map_inputs(folder: Path, settings: SlamSettings, parts: Mapping[str, Part]) -> dict[str, Any]:
    """Everything that a map depends on."""
    text = json.dumps(settings.model_dump(mode="json"), sort_keys=True)
    return {
        "folder": str(folder),
        "settings": hashlib.sha256(text.encode()).hexdigest(),
        "versions": {name: part.arguments["version"] for name, part in parts.items()},
    }


def _is_up_to_date(previous: Merged, out: Path, inputs: Mapping[str, Any]) -> bool:
    """Whether the existing map contains exactly the recorded drives, made from the same inputs as now."""
    try:
        with MapStore.open(out, read_only=False) as store:  # this recovers the file after a killed merge
            size = store.size
    except Dpm2Error:  # none, or damaged
        return False
    if size != sum(previous.drives.values()):  # the map was written, but not its record
        return False
    versions, old = inputs["versions"], previous.made.get("versions", {})
    if any(versions.get(name) != old.get(name) for name in previous.drives):
        return False
    return all(previous.made.get(key) == inputs[key] for key in ("folder", "settings"))


def _keyframe_counts(places: Mapping[str, Figures]) -> dict[str, int]:
    return {name: int(figures["keyframes"]) for name, figures in places.items()}


def _extend_map(previous: Merged, out: Path, search: Search, sizes: Mapping[str, int], joins: Sequence[Join],
           largest: int) -> Merged | None:  # fmt: skip
    """The map with the drives that are connected to it; None: it must be made again."""
    inside, rows = previous.drives, {(row["drives"][0], row["drives"][1]): row for row in previous.joins}
    accepted, refused = accepted_and_rejected(_reject_contradicted(previous, joins))
    connected = component(sizes, accepted, inside)
    if not set(inside) <= set(connected):
        return None
    new = [name for name in connected if name not in inside]
    connected_joins = [join for join in accepted if join.one in connected]
    with ExitStack() as stack:
        maps = _open_maps(new, search.folder, stack)
        store = stack.enter_context(MapStore.open(out, read_only=False))
        ties = [pair for pair, row in rows.items() if row["accepted"] and set(pair) <= set(inside)]
        growth = grown(Standing(store, inside, ties, search.settings.pose_graph, largest), maps, connected_joins)
        if growth is None:
            return None
        if growth.maps:
            with store.together():
                add_drives(store, inside, growth, refused)
    lost = joins_of(growth.judged.values(), inside)
    unconnected_joins = [join for join in accepted if join.one not in connected]
    found = _rows([*growth.joins, *refused, *unconnected_joins])
    kept = [_without_loops(row, lost) for pair, row in rows.items() if set(pair) <= set(inside)]
    drives = {**inside, **{name: sizes[name] for name in growth.maps}}
    return Merged(drives, {}, sorted([*kept, *found], key=lambda row: row["drives"]))


def _build_map(out: Path, search: Search, sizes: Mapping[str, int], joins: Sequence[Join], largest: int) -> Merged:
    """The map of the connected drives that have the most keyframes."""
    accepted, refused = accepted_and_rejected(joins)
    with ExitStack() as stack:
        maps = _open_maps(sizes, search.folder, stack)
        while True:
            region = solve(maps, accepted, search.settings.pose_graph, largest)
            accepted, contradicted = accepted_and_rejected(region.joins)
            refused += contradicted
            if not any(join.loop.ok for join in contradicted):  # else these drives would be tied by too few
                break
        connected = component(sizes, accepted)
        moved = {name: replace(maps[name], poses=region.poses[name]) for name in connected}
        new_file = part_beside(out)
        try:
            with named(out, new_file), MapStore.create(new_file) as store:
                add_drives(store, {}, Growth(moved, accepted), refused)
            if not _record_path(
                out
            ).exists():  # without it the map would be taken for another program's, if this ends here
                write_json(_record_path(out), asdict(Merged({}, {})))
            move_map(new_file, out)
        finally:
            remove_map(new_file)
    return Merged({name: sizes[name] for name in connected}, {}, _rows([*accepted, *refused]))


def _reject_contradicted(previous: Merged, joins: Sequence[Join]) -> list[Join]:
    """The joins, rejected if the existing map has contradicted those of the two drives."""
    refused = {(row["drives"][0], row["drives"][1]) for row in previous.joins if row["accepted"] < ENOUGH}
    return [
        replace(join, loop=join.loop.rejected("the map contradicts the loops between the two drives"))
        if join.loop.ok and (join.one, join.other) in refused
        else join
        for join in joins
    ]


def _open_maps(names: Iterable[str], folder: Path, stack: ExitStack) -> dict[str, MapData]:
    """The maps of drives, which stay open for their clouds; descriptors are read on demand."""
    stores = {name: stack.enter_context(MapStore.open(folder / name / MAP)) for name in names}
    return {name: load_map(store, descriptors=False) for name, store in stores.items()}


def _rows(joins: Sequence[Join]) -> list[dict[str, Any]]:
    pairs: dict[tuple[str, str], list[Join]] = defaultdict(list)
    for join in joins:
        pairs[join.one, join.other].append(join)
    return [
        _row(
            pair, sum(join.loop.ok for join in of_pair), Counter(_reason(join) for join in of_pair if not join.loop.ok)
        )
        for pair, of_pair in sorted(pairs.items())
    ]


def _row(drives: Sequence[str], accepted: int, reasons: Counter[str]) -> dict[str, Any]:
    rejected = {"rejected": reasons.total(), "reasons": dict(reasons.most_common())}
    return {"drives": list(drives), "accepted": accepted, **rejected}


def _reason(join: Join) -> str:
    return "".join(c for c in join.loop.registration.reason if not c.isdigit())


def _without_loops(row: dict[str, Any], lost: Sequence[Join]) -> dict[str, Any]:
    """A row, updated after loops of its two drives turned out to be wrong."""
    lost_here = [join for join in lost if [join.one, join.other] == row["drives"]]
    return _row(
        row["drives"], row["accepted"] - len(lost_here), Counter(row["reasons"]) + Counter(map(_reason, lost_here))
    )
