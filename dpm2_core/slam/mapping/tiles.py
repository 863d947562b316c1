# SPDX-License-Identifier: Apache-2.0
"""A map as tiles: a folder with a map file for each square of the ground; only those around the robot are open.

In the same folder, tiles.json lists the tiles, and a table has one vector per keyframe. With these vectors a robot that
does not know its pose finds the tiles that look like its scan.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.files import new_folder, write_json
from dpm2_core.frame import Array
from dpm2_core.slam.loops.relocalization import CANDIDATES, RelocalizationSettings, Relocalizer, nowhere
from dpm2_core.slam.loops.retrieval import WIDTH, Vector, centered, pooled
from dpm2_core.slam.mapping.merge import merge_maps
from dpm2_core.slam.store.map_data import MapData, load_map, save_as, subset
from dpm2_core.slam.store.map_file import SUFFIX
from dpm2_core.slam.store.map_store import MapStore

INDEX, VECTORS = "tiles.json", "places.npy"
_BLOCK = 65_536  # vectors that are compared at once: 140 MB
_MIN_SIZE, _MAX_TILES = 10.0, 1_000_000  # m, edge of a tile; number of tiles of a map

Tile = tuple[int, int]
"""A tile: position of its corner in x and y, in units of its edge."""


def write_tiles(data: MapData, folder: Path, size: float) -> int:
    """Write a map as tiles with an edge of `size`, m; the folder appears whole or not at all.

    A keyframe that borrows its cloud is left out: its lender shows the same.

    Returns:
        The number of tiles.

    Raises:
        UsageError: the folder exists, or the tiles are too small. Dpm2Error: it could not be written.
    """
    if not _MIN_SIZE <= size < math.inf:
        raise UsageError(f"tiles of {size:g} m: want at least {_MIN_SIZE:g} m")
    if folder.exists():
        raise UsageError(f"{folder}: is there already")
    squares: dict[Tile, list[int]] = {}
    for node, (x, y) in enumerate(np.floor(data.poses[:, :2, 3] / size).astype(int).tolist()):
        if data.clouds.loan(node) is None:
            squares.setdefault((x, y), []).append(node)
    square_of = {node: tile for tile, nodes in squares.items() for node in nodes}
    edges: dict[Tile | None, list[Edge]] = {}  # None: at a keyframe that is left out
    for edge in data.constraints:
        if (tile := square_of.get(edge.from_node)) == square_of.get(edge.to_node):
            edges.setdefault(tile, []).append(edge)
    with new_folder(folder) as part:
        vectors = np.array([_place_vector(data, node) for _, nodes in sorted(squares.items()) for node in nodes])
        mean = np.asarray(vectors.sum(0) / max(int(vectors.any(1).sum()), 1), np.float32)
        np.save(part / VECTORS, centered(vectors, mean))
        for tile, nodes in squares.items():
            save_as(subset(data, nodes, edges.get(tile, []), []), part / _file_name(tile))
        counts = [[*tile, len(nodes)] for tile, nodes in sorted(squares.items())]
        weights = sorted({session.weights for session in data.sessions if session.weights})
        write_json(part / INDEX, {"size": size, "tiles": counts, "weights": weights, "mean": mean.tolist()})
    return len(squares)


def _place_vector(data: MapData, node: int) -> Vector:
    descriptors = data.descriptors(node)
    return np.zeros(WIDTH, np.float32) if descriptors is None else pooled(descriptors)


def _file_name(tile: Tile) -> str:
    return f"{tile[0]}_{tile[1]}{SUFFIX}"


class TiledMap:
    """A folder of tiles, opened for reading. A context manager, as `MapStore`.

    Attributes:
        path: the folder. size: edge of a tile, m. weights: ids of the weights that made its descriptors.
    """

    read_only = True

    def __init__(self, path: Path) -> None:
        """Open the folder; only the index is read.

        Raises:
            UsageError: no such folder. Dpm2Error: its index is damaged.
        """
        self.path = path
        self._files: dict[Tile, tuple[MapStore, MapData]] = {}
        try:
            read = json.loads((path / INDEX).read_text(encoding="utf-8"))
            self.size, self.weights = float(read["size"]), [str(weights) for weights in read["weights"]]
            self._counts: dict[Tile, int] = {(int(x), int(y)): int(count) for x, y, count in read["tiles"]}
            self._mean = np.array(read["mean"], np.float32)
            self._vectors = np.load(path / VECTORS, mmap_mode="r", allow_pickle=False)
            sizes = _MIN_SIZE <= self.size < math.inf and 0 < len(self._counts) <= _MAX_TILES
            shapes = self._mean.shape, self._vectors.shape, self._vectors.dtype
            if not sizes or shapes != ((WIDTH,), (sum(self._counts.values()), WIDTH), np.float32):
                raise ValueError
            if min(self._counts.values()) < 1 or not np.isfinite(self._mean).all():
                raise ValueError
        except FileNotFoundError:
            raise UsageError(f"{path}: no folder of tiles, as `dpm2 map export --tiles` writes it") from None
        except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            raise Dpm2Error(f"{path}: the index of its tiles is damaged") from None

    def __enter__(self) -> TiledMap:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        self._close_others(())

    @property
    def described(self) -> bool:
        """Whether any keyframe has descriptors."""
        return bool(self.weights) or bool(self._vectors.any())

    @property
    def open(self) -> set[Tile]:
        """The tiles whose keyframes are in memory."""
        return set(self._files)

    def around(self, xy: Array, reach: float) -> list[Tile]:
        """The existing tiles within `reach`, m, of a position (2,)."""
        low, high = (np.floor((xy + side * reach) / self.size).astype(int).tolist() for side in (-1, 1))
        candidates = ((x, y) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1))
        return [tile for tile in candidates if tile in self._counts]

    def like(self, vector: Vector, count: int) -> list[Tile]:
        """The tiles of the `count` keyframes in the whole map that are most similar to a place vector (528,)."""
        (query,) = centered(vector[None], self._mean)
        best: list[tuple[float, int]] = []
        for first in range(0, len(self._vectors), _BLOCK):
            cosine = np.nan_to_num(self._vectors[first : first + _BLOCK] @ query, nan=-1)
            top = np.argsort(-cosine, kind="stable")[:count]
            best = sorted([*best, *zip((-cosine[top]).tolist(), (top + first).tolist(), strict=True)])[:count]
        tiles, ends = list(self._counts), np.cumsum(list(self._counts.values()))
        return list(dict.fromkeys(tiles[int(np.searchsorted(ends, node, side="right"))] for _, node in best))

    def read(self, tiles: Collection[Tile]) -> tuple[MapData, str]:
        """One map of these tiles, at least one, and why one of them is missing in it, in words; empty if none is. All
        other tiles are closed.

        Raises:
            Dpm2Error: all are missing or damaged.
        """
        self._close_others(tiles)
        problems = list[Dpm2Error]()
        for tile in tiles:
            if tile not in self._files:
                try:
                    self._files[tile] = self._open_tile(tile)
                except Dpm2Error as error:
                    problems.append(error)
        found = [self._files[tile][1] for tile in tiles if tile in self._files]
        if not found:
            raise problems[0]
        return reduce(lambda a, b: merge_maps(a, b, np.eye(4)), found), str(problems[0]) if problems else ""

    def _open_tile(self, tile: Tile) -> tuple[MapStore, MapData]:
        store = MapStore.open(self.path / _file_name(tile))
        try:
            data = load_map(store)
            if len(data) != self._counts[tile]:
                raise Dpm2Error(f"{store.path}: {len(data)} keyframes, the index says {self._counts[tile]}")
        except BaseException:
            store.close()
            raise
        return store, data

    def _close_others(self, tiles: Collection[Tile]) -> None:
        for tile in self.open - set(tiles):
            self._files.pop(tile)[0].close()


class TiledRelocalizer:
    """Localizes clouds in a tiled map, as `Relocalizer` does in a map; tiles around the last pose are in memory."""

    def __init__(
        self,
        settings: RelocalizationSettings,
        tiles: TiledMap,
        make: Callable[[MapData], Relocalizer],
        describe: Callable[[Keyframe], Descriptors],
    ) -> None:
        """`make`: creates the relocalizer of a map in memory. `describe`: see `PlaceRecognition.descriptors`."""
        self._settings, self._tiles, self._make, self._describe = settings, tiles, make, describe
        self._relocalizer: Relocalizer | None = None
        self._problem = ""  # why a tile is missing

    def find(self, keyframe: Keyframe, hint: Array | None = None) -> Registration:
        """As `Relocalizer.find`: around a hint, or else in the tiles that look like the cloud.

        Raises:
            Dpm2Error: it is not found, and a tile is missing or damaged.
        """
        try:
            keyframe = replace(keyframe, descriptors=(descriptors := self._describe(keyframe)))
        except Dpm2Error as error:
            return nowhere(str(error))
        if hint is None:
            tiles = self._tiles.like(pooled(descriptors), CANDIDATES)
        else:
            tiles = self._tiles.around(hint[:2, 3], self._settings.hint_radius)
        self._load_tiles(tiles)
        return self._result_of(lambda relocalizer: relocalizer.find(keyframe, hint))

    def verify(self, keyframe: Keyframe, T_map_lidar: Array) -> Registration:
        """As `Relocalizer.verify`.

        Raises:
            Dpm2Error: it is not confirmed, and a tile is missing or damaged.
        """
        xy, reach = T_map_lidar[:2, 3], self._settings.surroundings
        if not self._tiles.open or not set(self._tiles.around(xy, reach)) <= self._tiles.open:
            # More, so that the next call needs none.
            self._load_tiles(self._tiles.around(xy, max(self._tiles.size, reach)))
        return self._result_of(lambda relocalizer: relocalizer.verify(keyframe, T_map_lidar))

    def _load_tiles(self, tiles: Collection[Tile]) -> None:
        self._relocalizer, self._problem = None, ""
        if tiles:
            data, self._problem = self._tiles.read(tiles)
            self._relocalizer = self._make(data)

    def _result_of(self, query: Callable[[Relocalizer], Registration]) -> Registration:
        """The result with the loaded tiles; if it is not ok and a tile is missing, raise the problem."""
        result = nowhere("outside the map") if self._relocalizer is None else query(self._relocalizer)
        if self._problem and not result.ok:
            raise Dpm2Error(self._problem)
        return result
