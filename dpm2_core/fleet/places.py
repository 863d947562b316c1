# SPDX-License-Identifier: Apache-2.0
"""The place vectors of many drives in one index: for each keyframe the most similar ones of other drives.

A graph is searched (HNSW, by faiss): Y. Malkov, D. Yashunin, "Efficient and Robust Approximate Nearest Neighbor Search
Using Hierarchical Navigable Small World Graphs", TPAMI 2020.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.console import Advance
from dpm2_core.errors import Dpm2Error
from dpm2_core.extras import needs
from dpm2_core.files import atomic_write, write_json
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.slam.loops.retrieval import WIDTH, Vector, centered, pooled
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

_WORK = "dpm2_core.fleet.places:describe"
_PLACES_FOLDER, _VECTORS_FILE = "places", "places.npy"
_GRAPH_FILE, _RECORD_FILE = "index.faiss", "index.json"
_MAX_OUTSIDE_GRAPH = 20_000
"""Up to this number of places each is compared: 100 keyframes then cost 30 ms, and 0.3 s to add them to the graph."""
_QUERY_BATCH = 256  # queries: all cosines of a long drive would be gigabytes
_GRAPH_NEIGHBORS, _EF_CONSTRUCTION, _EF_SEARCH = 32, 80, 64
"""Settings of the graph: neighbors of a place; places examined when one is added, and when one is searched for."""


def places_part(name: str, path: Path) -> Part:
    """The part that reads the places of a drive's map."""
    stat = path.stat()
    return Part(
        f"{_PLACES_FOLDER}/{name}", _WORK, {"path": path, "version": [stat.st_size, stat.st_mtime_ns]}, fresh=True
    )


def describe(folder: Path, advance: Advance, path: Path, version: Sequence[int]) -> Figures:
    """Check a whole map, and write the vectors of its places.

    Raises:
        Dpm2Error: the map is damaged, or has no descriptors; nothing of it should be used.
    """
    del advance, version  # quick; the version only identifies another map of that name
    if problems := check_map(path).problems:
        raise Dpm2Error(f"{path}: {problems[0]}; see dpm2 map check")
    with MapStore.open(path) as store:
        data = load_map(store, descriptors=False)
        vectors = np.zeros((len(data), WIDTH), np.float32)
        for node in np.flatnonzero(data.clouds.own).tolist():  # else all candidates are one place
            if (descriptors := data.descriptors(node)) is not None:
                vectors[node] = pooled(descriptors)
    if not vectors.any():
        raise Dpm2Error(f"{path}: no keyframe has descriptors, by which it could be found in the others")
    np.save(folder / _VECTORS_FILE, vectors)
    return {"keyframes": len(data), "weights": sorted({s.weights for s in data.sessions if s.weights})}


def vectors_of(out: Path, name: str) -> Vector:
    """Vectors (N, 528) of a drive whose part is done; zeros for keyframes without descriptors of their own."""
    return np.asarray(np.load(out / _PLACES_FOLDER / name / _VECTORS_FILE), np.float32)


class FleetIndex:
    """Index of the places of all drives, in the order in which they were added; stored next to each drive's vectors.

    Vectors are compared by their cosine, after the mean of the first drive's is subtracted: what all places share does
    not distinguish them. Places that were added late are compared one by one, until adding them to the graph pays off:
    so a drive costs the same in a large map as in a small one.

    Attributes:
        drives: name, version, and number of keyframes of each.
    """

    drives: list[tuple[str, Sequence[int], int]]
    _graph: Any
    _outside_graph: Vector

    def __init__(self, folder: Path) -> None:
        """Load the index from the folder of the drives' places, if it is complete."""
        with needs("fleet", "the index of places"):
            import faiss
        self._faiss: Any = faiss
        self._folder = folder
        self.clear()
        try:
            record = json.loads((folder / _RECORD_FILE).read_text(encoding="utf-8"))
            drives: list[Any] = [(str(name), list(version), int(count)) for name, version, count in record["drives"]]
            mean = np.array(record["mean"], np.float32).reshape(WIDTH)
            graph = self._read_graph(int(record["linked"]))
            first_places = np.cumsum([0, *(count for *_, count in drives)]).tolist()
            outside_graph = drives[first_places.index(0 if graph is None else graph.ntotal) :]
            vectors = [vectors_of(folder, name) for name, *_ in outside_graph]
            if [each.shape for each in vectors] != [(count, WIDTH) for *_, count in outside_graph]:
                return
        except (OSError, EOFError, ValueError, KeyError, TypeError, OverflowError):
            return  # none, or an incomplete one: it is made again
        self.drives, self._mean, self._graph = drives, mean, graph
        self._outside_graph = np.concatenate([self._outside_graph, *(centered(each, mean) for each in vectors)])

    def _read_graph(self, linked: int) -> Any:
        """The stored graph of `linked` places; None if missing, another one, or damaged: then each is compared."""
        with suppress(RuntimeError):
            graph = self._faiss.read_index(str(self._folder / _GRAPH_FILE)) if linked else None
            if graph is not None and (graph.ntotal, graph.d) == (linked, WIDTH):
                return graph
        return None

    def clear(self) -> None:
        """Drop all places, e.g. if a drive has changed."""
        self.drives = []
        self._mean = np.zeros(WIDTH, np.float32)
        self._graph = None
        self._outside_graph = np.zeros((0, WIDTH), np.float32)  # places after those in the graph
        self._graph_changed = False  # whether the graph differs from its file

    @property
    def _graph_size(self) -> int:
        """Places in the graph."""
        return 0 if self._graph is None else int(self._graph.ntotal)

    def similar(self, vectors: Vector, count: int) -> NDArray[np.int64]:
        """(M, count) places in the index most similar to each of (M, 528), the most similar first; -1: none.

        Places are numbered over all drives: the keyframes of the first drive, then those of the second.
        """
        queries = centered(vectors, self._mean)
        cosines = [np.full((len(vectors), count), -np.inf, np.float32)]
        places = [np.full((len(vectors), count), -1)]
        if self._graph is not None:
            self._graph.hnsw.efSearch = _EF_SEARCH
            found = self._graph.search(queries, count)
            cosines.append(found[0])
            places.append(found[1])
        if len(self._outside_graph):
            found = _compare_all(queries, self._outside_graph, min(count, len(self._outside_graph)))
            cosines.append(found[0])
            places.append(found[1] + self._graph_size)
        best = np.argsort(-np.hstack(cosines), axis=1, kind="stable")[:, :count]
        out = np.take_along_axis(np.hstack(places), best, 1)
        out[~vectors.any(1)] = -1
        return np.asarray(out, np.int64)

    def add(self, name: str, version: Sequence[int], vectors: Vector) -> None:
        """Add a drive."""
        if not self.drives:
            self._mean = vectors[vectors.any(1)].mean(0)
        rows = centered(vectors, self._mean)
        self.drives.append((name, list(version), len(vectors)))
        self._outside_graph = np.concatenate([self._outside_graph, rows])
        if len(self._outside_graph) > _MAX_OUTSIDE_GRAPH:
            self._add_to_graph()

    def _add_to_graph(self) -> None:
        """Add the late places to the graph."""
        if self._graph is None:
            self._graph = self._faiss.IndexHNSWFlat(WIDTH, _GRAPH_NEIGHBORS, self._faiss.METRIC_INNER_PRODUCT)
        self._graph.hnsw.efConstruction = _EF_CONSTRUCTION
        self._graph.add(self._outside_graph)
        self._outside_graph, self._graph_changed = self._outside_graph[:0], True

    def save(self) -> None:
        """Write the parts of the index that do not follow from the drives' vectors to its folder.

        Raises:
            Dpm2Error: it cannot be written. The earlier files stay usable.
        """
        if self._graph_changed:
            with atomic_write(self._folder / _GRAPH_FILE, "wb") as file:
                file.write(self._faiss.serialize_index(self._graph).tobytes())
            self._graph_changed = False
        record = {"drives": self.drives, "mean": self._mean.tolist(), "linked": self._graph_size}
        write_json(self._folder / _RECORD_FILE, record)


def _compare_all(queries: Vector, places: Vector, count: int) -> tuple[Vector, NDArray[np.int64]]:
    """Cosines (M, count) of the places most similar to each of the queries (M, 528), unsorted, and the indices of these
    places."""
    cosines = np.empty((len(queries), count), np.float32)
    indices = np.empty((len(queries), count), np.int64)
    for start in range(0, len(queries), _QUERY_BATCH):
        rows = slice(start, start + _QUERY_BATCH)
        block = queries[rows] @ places.T
        indices[rows] = np.argpartition(block, -count, axis=1)[:, -count:]
        cosines[rows] = np.take_along_axis(block, indices[rows], 1)
    return cosines, indices
