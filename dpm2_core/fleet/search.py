# SPDX-License-Identifier: Apache-2.0
"""Search for drives that share places: the places of each, similar places of others, and the confirmed loops there.

Results are stored in DIR/.merge, drive by drive and stretch by stretch: the cost of another drive depends on what it
touches.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from dpm2_core.errors import Dpm2Error
from dpm2_core.files import write_json
from dpm2_core.fleet.cluster import Cluster
from dpm2_core.fleet.drives import MAP
from dpm2_core.fleet.joins import ENOUGH, edge_from, join_part, stretches
from dpm2_core.fleet.part import Figures, Outcome, Part, is_whole
from dpm2_core.fleet.places import FleetIndex, places_part, vectors_of
from dpm2_core.fleet.regions import Join, first_nodes, owners
from dpm2_core.fleet.run import View, do_parts, not_done
from dpm2_core.network.pretrained import weights_id
from dpm2_core.slam.loops.retrieval import Vector
from dpm2_core.slam.settings import SlamSettings

_RESULTS_FOLDER = ".merge"
_CANDIDATES_PER_KEYFRAME = 8
"""Similar places that are found for each keyframe."""


@dataclass(frozen=True)
class Search:
    """Folder of the drives, and the search for joins between them.

    Attributes:
        folder: of the drives. cluster: entered. view: shows the progress.
    """

    folder: Path
    settings: SlamSettings
    cluster: Cluster
    view: View

    @property
    def kept(self) -> Path:
        """Folder of the stored results."""
        return self.folder / _RESULTS_FOLDER

    def drives(self, left_out: dict[str, str]) -> dict[str, Part]:
        """The part that reads the places of each complete drive, in the order of their names."""
        found, missing = {}, not_done(self.folder)
        for path in sorted(self.folder.glob(f"*/{MAP}")):
            name = path.parent.name
            if name in missing:
                left_out[name] = f"not complete in the last run: {missing[name]}"
            elif is_whole(path.parent):
                found[name] = places_part(name, path)
            else:
                left_out[name] = "not complete: it is being written, or was interrupted"
        return found

    def places(self, parts: Mapping[str, Part], left_out: dict[str, str]) -> dict[str, Figures]:
        """Figures of the drives' maps that are undamaged and of the same weights, each drive once.

        Raises:
            Dpm2Error: there is no such map. KeyboardInterrupt: the search was stopped.
        """
        own = weights_id(self.settings.neural.weights)
        found: dict[str, Figures] = {}
        drives: dict[bytes, str] = {}  # by all their places: these are equal only for copies of a recording
        outcomes = self._run_parts(list(parts.values()))
        for name, outcome in zip(parts, outcomes, strict=True):
            if outcome.figures is None:
                left_out[name] = outcome.reason
            elif outcome.figures["weights"] != [own]:
                left_out[name] = f"made with weights {', '.join(outcome.figures['weights'])}, not with {own}"
            elif (twin := drives.setdefault(sha256(vectors_of(self.kept, name).tobytes()).digest(), name)) != name:
                left_out[name] = f"the same drive as {twin}: all its places are the same"
            else:
                found[name] = outcome.figures
        if not found:
            raise Dpm2Error("; ".join(f"{name}: {reason}" for name, reason in left_out.items()))
        return found

    def index(self, parts: Mapping[str, Part]) -> FleetIndex:
        """All these drives in one index. The candidates of a drive are found once, when it is added."""
        index = FleetIndex(self.kept)
        versions = {name: part.arguments["version"] for name, part in parts.items()}
        if any(
            versions.get(name) != version or not self._candidates_path(name).is_file()
            for name, version, _ in index.drives
        ):
            index.clear()  # a drive is missing or has changed, or its candidates are missing
        new = [name for name in parts if name not in {known for known, *_ in index.drives}]
        for name in new:
            vectors = vectors_of(self.kept, name)
            write_json(self._candidates_path(name), _find_candidates(index, vectors))
            index.add(name, versions[name], vectors)
        if new:
            index.save()
        return index

    def joins(self, parts: Mapping[str, Part], index: FleetIndex, inside: Collection[str] = ()) -> list[Join]:
        """Every loop that was tried between two drives, at least one of them not in `inside`.

        Raises:
            Dpm2Error: a search failed, or a stored result is damaged. KeyboardInterrupt: the search was stopped.
        """
        maps = {name: part.arguments for name, part in parts.items()}
        work: dict[str, tuple[Part, str, str]] = {}
        outside_found = False
        for name, *_ in index.drives:
            outside_found |= name not in inside
            for one, rows in (self._read_candidates(name) if outside_found else {}).items():
                if one not in inside or name not in inside:
                    for number, stretch in enumerate(stretches(one, name, np.array(rows))):
                        part = join_part(number, stretch, maps, self.settings)
                        work[part.name] = part, one, name
        outcomes = self._run_parts([part for part, *_ in work.values()])
        if failed := [outcome for outcome in outcomes if outcome.figures is None]:
            raise Dpm2Error(f"{len(failed)} of {len(work)} stretches failed: {failed[0].name}: {failed[0].reason}")
        found: dict[tuple[str, str, int, int], Join] = {}
        for outcome in outcomes:
            _, one, other = work[outcome.name]
            for figures in (outcome.figures or {})["loops"]:
                join = Join(one, other, edge_from(figures))
                key = one, other, join.loop.from_node, join.loop.to_node
                if key not in found or join.loop.ok:
                    found[key] = join
        return list(found.values())

    def _run_parts(self, parts: Sequence[Part]) -> list[Outcome]:
        outcomes = do_parts(parts, self.kept, self.cluster, self.view)
        if any(outcome.state == "stopped" for outcome in outcomes):
            raise KeyboardInterrupt  # else the map would lose the drives that were not examined
        return outcomes

    def _candidates_path(self, name: str) -> Path:
        return self.kept / "candidates" / f"{name}.json"

    def _read_candidates(self, name: str) -> dict[str, list[list[int]]]:
        """The candidates of a drive, as `index` wrote them."""
        path = self._candidates_path(name)
        try:
            return TypeAdapter(dict[str, list[list[int]]]).validate_json(path.read_bytes())
        except (OSError, ValueError):
            raise Dpm2Error(f"{path}: damaged; remove the folder {self.kept}, and it is made again") from None


def _find_candidates(index: FleetIndex, vectors: Vector) -> dict[str, list[list[int]]]:
    """For each drive in the index: pairs of its node and the node of the new drive that look alike."""
    first = first_nodes({name: count for name, _, count in index.drives})
    out: dict[str, list[list[int]]] = defaultdict(list)
    for node, found in enumerate(index.similar(vectors, _CANDIDATES_PER_KEYFRAME)):
        places = found[found >= 0].tolist()
        for place, name in zip(places, owners(places, first), strict=True):
            out[name].append([place - first[name], node])
    return out


def accepted_and_rejected(joins: Sequence[Join]) -> tuple[list[Join], list[Join]]:
    """The accepted loops of pairs of drives that have enough of them; and all others, with the reason."""
    by_pair: dict[tuple[str, str], list[Join]] = defaultdict(list)
    rejected = []
    for join in joins:
        if join.loop.ok:
            by_pair[join.one, join.other].append(join)
        else:
            rejected.append(join)
    accepted: list[Join] = []
    for of_pair in by_pair.values():
        nodes = {join.loop.to_node for join in of_pair}
        if len(nodes) >= ENOUGH:
            accepted += of_pair
        else:
            reason = f"only {len(nodes)} keyframes of the two drives agree, {ENOUGH} must"
            rejected += [replace(join, loop=join.loop.rejected(reason)) for join in of_pair]
    return accepted, rejected


def component(sizes: Mapping[str, int], joins: Sequence[Join], inside: Collection[str] = ()) -> list[str]:
    """The connected drives that have the most keyframes, in their order.

    Args:
        sizes: keyframes of each. inside: drives that are connected already.
    """
    root = next(iter(inside), "")
    part = {name: root if name in inside else name for name in sizes}
    for join in joins:
        one, other = part[join.one], part[join.other]
        if one != other:
            part = {name: one if root == other else root for name, root in part.items()}
    total: dict[str, int] = defaultdict(int)
    for name, root in part.items():
        total[root] += sizes[name]
    largest = max(total, key=lambda root: total[root])
    return [name for name in sizes if part[name] == largest]
