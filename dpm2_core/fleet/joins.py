# SPDX-License-Identifier: Apache-2.0
"""Places where two drives meet: stretches that look alike, and loops between them that network and points confirm."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.console import Advance
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.frame import Array, Points
from dpm2_core.slam.build import make_loops
from dpm2_core.slam.mapping.parts import parts_of
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.lazy import LazySequence
from dpm2_core.slam.store.map_data import MapData, borrowing, load_map
from dpm2_core.slam.store.map_store import MapStore

ENOUGH = 3
"""Loops that a join of two drives needs: two can be wrong in the same way if houses look alike."""
_WORK = "dpm2_core.fleet.joins:verify"
_MAX_GAP = 8  # keyframes without a candidate, over which a stretch continues
_MAX_STRETCH = 40  # keyframes of a stretch: a task of a minute
_CONTEXT = 6  # keyframes before and after a candidate that are used with it: 22 m of surroundings and more


@dataclass(frozen=True)
class Stretch:
    """Keyframes of one drive, and keyframes of another one that look like them, as nodes of their maps."""

    one: str
    other: str
    one_nodes: tuple[int, ...]
    other_nodes: tuple[int, ...]


def stretches(one: str, other: str, pairs: NDArray[np.int64]) -> Iterator[Stretch]:
    """Group candidates (M, 2), node of one drive and of the other; groups of too few keyframes are left out."""
    pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
    begins = [0]
    for row in range(1, len(pairs)):
        node = pairs[row, 1]
        if node - pairs[row - 1, 1] > _MAX_GAP or node - pairs[begins[-1], 1] >= _MAX_STRETCH:
            begins.append(row)
    for begin, end in zip(begins, [*begins[1:], len(pairs)], strict=True):
        group = pairs[begin:end]
        if len(np.unique(group[:, 1])) >= ENOUGH:
            one_nodes = {int(node) + step for node in group[:, 0] for step in range(-_CONTEXT, _CONTEXT + 1)}
            last = int(group[-1, 1])
            yield Stretch(one, other, tuple(sorted(one_nodes)), tuple(range(int(group[0, 1]), last + 1)))


def join_part(number: int, stretch: Stretch, maps: Mapping[str, Mapping[str, Any]], slam: SlamSettings) -> Part:
    """The part that searches for the loops of a stretch; `maps` contains path and version of each drive's map."""
    arguments = {
        "one": maps[stretch.one],
        "other": maps[stretch.other],
        "nodes": [stretch.one_nodes, stretch.other_nodes],
        "slam": slam,
    }
    return Part(f"joins/{stretch.one}/{stretch.other}/{number}", _WORK, arguments, fresh=True)


def verify(
    folder: Path,
    advance: Advance,
    one: Mapping[str, Any],
    other: Mapping[str, Any],
    nodes: Sequence[Sequence[int]],
    slam: SlamSettings,
) -> Figures:
    """Every loop that was tried from a node of the first drive to one of the other, as `edge_figures`.

    Raises:
        Dpm2Error: a map cannot be read.
    """
    del folder
    loop_closure = make_loops(slam)
    with MapStore.open(one["path"]) as a, MapStore.open(other["path"]) as b:
        first, second = _read_excerpt(a, nodes[0], "one"), _read_excerpt(b, nodes[1], "other")
        clouds = _Clouds([first, second])
        keyframes, poses = list(first.keyframes), np.concatenate([first.poses, second.poses])
        parts = np.concatenate([first.parts, second.parts + len(first.data)])  # the two have no part in common
        own = np.concatenate([first.own, second.own])
        tried: dict[tuple[int, int], Edge] = {}
        for count, keyframe in enumerate(second.keyframes, 1):
            keyframes.append(keyframe)
            end = len(keyframes)
            for loop in loop_closure.close(keyframes, clouds, poses[:end], parts[:end], own[:end]):
                if loop.from_node < len(first.nodes) <= loop.to_node:
                    ends = first.nodes[loop.from_node], second.nodes[loop.to_node - len(first.nodes)]
                    tried[ends] = loop.between(*ends)  # a later result: confirmed by another loop
            advance(count, len(second.keyframes))
    return {"loops": [edge_figures(loop) for loop in tried.values()]}


@dataclass(frozen=True, eq=False)
class _Excerpt:
    """Some keyframes of a map: their nodes, keyframes with descriptors, poses (N, 4, 4), parts (N,), whether their
    cloud is their own (N,), and the whole map."""

    nodes: list[int]
    keyframes: list[Keyframe]
    poses: Array
    parts: NDArray[np.integer]
    own: NDArray[np.bool_]
    data: MapData


def _read_excerpt(store: MapStore, nodes: Sequence[int], robot: str) -> _Excerpt:
    data = load_map(store, descriptors=False)
    chosen = [node for node in nodes if 0 <= node < len(data)]
    keyframes: list[Keyframe] = []
    for node in chosen:
        loan = data.clouds.loan(node)
        owner = node if loan is None else loan.lender
        owner_keyframe = replace(data.keyframes[owner], descriptors=data.descriptors(owner))
        keyframe = owner_keyframe if loan is None else borrowing(data.keyframes[node], {owner: owner_keyframe}, loan)  # type: ignore[arg-type]
        continues = node - 1 in chosen and data.keyframes[node - 1].robot == keyframe.robot
        # Separate names keep the odometry of the two apart; a gap begins another stretch of odometry.
        keyframes.append(replace(keyframe, robot=robot, edge=keyframe.edge if continues else None))
    return _Excerpt(chosen, keyframes, data.poses[chosen], parts_of(data)[chosen], data.clouds.own[chosen], data)


class _Clouds(LazySequence[Points]):
    """The clouds of excerpts, one after the other, read on demand."""

    def __init__(self, excerpts: Sequence[_Excerpt]) -> None:
        self._sources = [(excerpt.data, node) for excerpt in excerpts for node in excerpt.nodes]

    def __len__(self) -> int:
        return len(self._sources)

    def item(self, index: int) -> Points:
        """(M, 4)."""
        data, node = self._sources[index]
        return data.clouds[node]


def edge_figures(edge: Edge) -> Figures:
    """A loop in a form for JSON."""
    r = edge.registration
    numbers = {"confidence": float(r.confidence), "rmse": float(r.rmse), "ok": bool(r.ok)}
    matrices = {"T": r.T_target_source.tolist(), "covariance": r.covariance.tolist()}
    return {
        "ends": [int(edge.from_node), int(edge.to_node)],
        **matrices,
        **numbers,
        "method": r.method,
        "reason": r.reason,
    }


def edge_from(figures: Mapping[str, Any]) -> Edge:
    """The inverse of `edge_figures`."""
    T, covariance = np.array(figures["T"]), np.array(figures["covariance"])
    numbers = figures["confidence"], figures["rmse"], figures["method"], figures["ok"], figures["reason"]
    one, other = figures["ends"]
    return Edge("loop", one, other, Registration(T, covariance, *numbers))
