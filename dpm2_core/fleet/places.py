# SPDX-License-Identifier: Apache-2.0
"""The place vectors of many drives in one index: for each keyframe those of other drives that look most alike.

A graph is searched (HNSW, by faiss): Y. Malkov, D. Yashunin, "Efficient and Robust Approximate Nearest Neighbor Search
Using Hierarchical Navigable Small World Graphs", TPAMI 2020.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import Dpm2Error
from dpm2_core.extras import needs
from dpm2_core.files import atomic_write, write_json
from dpm2_core.fleet.part import Advance, Figures, Part
from dpm2_core.slam.loops.retrieval import WIDTH, Vector, centered, pooled
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

_WORK = "dpm2_core.fleet.places:describe"
_VECTORS = "places.npy"
_INDEX, _LISTED = "index.faiss", "index.json"
_LINKS, _BUILD, _SEARCH = 32, 80, 64
"""Of the graph: neighbors of a place; how many are looked at when one is added, and when one is searched for."""


def places_part(name: str, path: Path) -> Part:
    """The part that reads the places of a drive's map."""
    stat = path.stat()
    return Part(f"places/{name}", _WORK, {"path": str(path), "version": [stat.st_size, stat.st_mtime_ns]}, fresh=True)


def describe(folder: Path, advance: Advance, path: str, version: Sequence[int]) -> Figures:
    """Check a map, all of it, and write the vectors of its places.

    Raises:
        Dpm2Error: it is damaged, or has no descriptors; nothing of it should be used.
    """
    del advance, version  # quick; and only to know another map of that name by
    if problems := check_map(Path(path)).problems:
        raise Dpm2Error(f"{path}: {problems[0]}; see dpm2 map check")
    with MapStore.open(Path(path)) as store:
        data = load_map(store)
    vectors = np.zeros((len(data), WIDTH), np.float32)
    for node, keyframe in enumerate(data.keyframes):
        if keyframe.descriptors is not None:
            vectors[node] = pooled(keyframe.descriptors)
    if not vectors.any():
        raise Dpm2Error(f"{path}: no keyframe has descriptors, by which it could be found in the others")
    np.save(folder / _VECTORS, vectors)
    return {"keyframes": len(data), "weights": sorted({s.weights for s in data.sessions if s.weights})}


def vectors_of(out: Path, part: Part) -> Vector:
    """(N, 528) of a part that is done; zeros where a keyframe has none."""
    return np.asarray(np.load(out / part.name / _VECTORS), np.float32)


class FleetIndex:
    """The places of all drives in the order in which the drives came; kept in a folder.

    Vectors are compared by their cosine, less the mean of those that came first: what all places share does not tell
    them apart.

    Attributes:
        drives: name, version, and number of keyframes of each.
    """

    def __init__(self, folder: Path) -> None:
        """With what is in the folder, if it is whole."""
        with needs("fleet", "the index of places"):
            import faiss
        self._faiss: Any = faiss
        self._folder = folder
        self.drives: list[tuple[str, Sequence[int], int]] = []
        self._mean = np.zeros(WIDTH, np.float32)
        self._index: Any = None
        try:
            listed = json.loads((folder / _LISTED).read_text(encoding="utf-8"))
            index = faiss.read_index(str(folder / _INDEX))
            drives: list[Any] = [(str(name), list(version), int(count)) for name, version, count in listed["drives"]]
            if index.ntotal == sum(count for *_, count in drives) and index.d == WIDTH:
                self.drives, self._index = drives, index
                self._mean = np.array(listed["mean"], np.float32)
        except (OSError, ValueError, KeyError, TypeError, RuntimeError):
            pass  # none, or one that is not whole: it is made anew

    def clear(self) -> None:
        """Forget all: a drive has changed."""
        self.drives, self._index = [], None

    def similar(self, vectors: Vector, count: int) -> NDArray[np.int64]:
        """(M, count) places of the drives in it that look most like each of (M, 528), the most similar first; -1: none.

        A place is a number over all drives: the keyframes of the first, then those of the second.
        """
        if self._index is None:
            return np.full((len(vectors), count), -1)
        self._index.hnsw.efSearch = _SEARCH
        _, found = self._index.search(centered(vectors, self._mean), count)
        found[~vectors.any(1)] = -1
        return np.asarray(found, np.int64)

    def add(self, name: str, version: Sequence[int], vectors: Vector) -> None:
        """Take a drive in."""
        if self._index is None:
            self._mean = vectors[vectors.any(1)].mean(0)
            self._index = self._faiss.IndexHNSWFlat(WIDTH, _LINKS, self._faiss.METRIC_INNER_PRODUCT)
            self._index.hnsw.efConstruction = _BUILD
        self._index.add(centered(vectors, self._mean))
        self.drives.append((name, list(version), len(vectors)))

    def save(self) -> None:
        """Write it to its folder.

        Raises:
            Dpm2Error: it cannot be written.
        """
        with atomic_write(self._folder / _INDEX, "wb") as file:
            file.write(self._faiss.serialize_index(self._index).tobytes())
        write_json(self._folder / _LISTED, {"drives": self.drives, "mean": self._mean.tolist()})
