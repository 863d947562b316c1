# SPDX-License-Identifier: Apache-2.0
"""A map in tiles equals the map, but only the surroundings are open. Errors name what is damaged."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Edge, Registration
from dpm2_core.slam.loops.relocalization import RelocalizationSettings
from dpm2_core.slam.loops.retrieval import pooled
from dpm2_core.slam.mapping.tiles import INDEX, VECTORS, TiledMap, TiledRelocalizer, write_tiles
from dpm2_core.slam.session import open_for_localization
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.cloud_store import Loan
from dpm2_core.slam.store.map_data import MapData, load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.full_disk import largest_file
from test.helpers.maps import ring

SIZE = 50.0


@pytest.fixture
def data(noise: np.random.Generator) -> MapData:
    """A ring of 60 keyframes, 95 m across. All but one have descriptors, and one borrows the cloud of another."""
    made = ring(60, points=50)
    described = [
        replace(
            k,
            descriptors=Descriptors.of(noise.normal(size=(80, 3)).astype("f4"), noise.normal(size=(80, 40))),
        )
        for k in made.keyframes
    ]
    described[7] = made.keyframes[7]
    made.clouds.borrow(9, Loan(8, np.eye(4)))
    return replace(made, keyframes=described)


@pytest.fixture
def folder(tmp_path: Path, data: MapData) -> Path:
    assert write_tiles(data, tmp_path / "tiles", SIZE) == 4
    return tmp_path / "tiles"


def test_every_keyframe_with_a_cloud_is_in_the_tile_of_its_place(folder: Path, data: MapData) -> None:
    """The tile contains the keyframe's pose, cloud and descriptors, and the edges between its keyframes. Each tile is a
    valid map by itself."""
    found: dict[int, Path] = {}
    for path in folder.glob("*.dpm2map"):
        assert not check_map(path).problems
        corner = np.array([int(number) for number in path.stem.split("_")]) * SIZE
        with MapStore.open(path) as store:
            tile = load_map(store)
            for node, keyframe in enumerate(tile.keyframes):
                assert keyframe.id not in found
                found[keyframe.id] = path
                np.testing.assert_array_equal(tile.poses[node], data.poses[keyframe.id])
                assert ((tile.poses[node][:2, 3] >= corner) & (tile.poses[node][:2, 3] < corner + SIZE)).all()
                np.testing.assert_array_equal(tile.clouds[node], data.clouds[keyframe.id])
                assert (keyframe.descriptors is None) == (keyframe.id == 7)
            for edge in tile.edges:
                assert tile.keyframes[edge.to_node].id - tile.keyframes[edge.from_node].id in (1, 59)
    assert sorted(found) == [node for node in range(60) if node != 9]


def test_the_edges_of_a_map_are_passed_over_once_for_all_tiles(tmp_path: Path, data: MapData) -> None:
    class Counting(list[Edge]):
        visits = 0

        def __iter__(self) -> Iterator[Edge]:
            for edge in super().__iter__():
                self.visits += 1
                yield edge

    edges = Counting(data.edges)
    assert write_tiles(replace(data, edges=edges), tmp_path / "tiles", 10.0) == 35
    assert edges.visits == len(edges)


def test_only_the_tiles_that_are_asked_for_are_open(folder: Path, data: MapData) -> None:
    with TiledMap(folder) as tiles:
        assert tiles.around(np.array([1000.0, 0.0]), 100.0) == []
        assert len(tiles.around(np.zeros(2), 5.0)) == 4
        (one,) = tiles.around(np.array([25.0, 25.0]), 5.0)
        assert tiles.open == set()
        assert len(tiles.read([one])[0]) == 15
        both, _ = tiles.read([one, (-1, 0)])
        assert tiles.open == {one, (-1, 0)}
        np.testing.assert_allclose(both.poses[:, 2, 3], data.poses[0, 2, 3])
        assert (both.poses[:, 1, 3] >= 0).all()
        tiles.read([(-1, 0)])
        assert tiles.open == {(-1, 0)}


def test_a_place_is_looked_for_in_the_tile_that_looks_like_it(folder: Path, data: MapData) -> None:
    with TiledMap(folder) as tiles:
        for node in range(0, 60, 8):
            descriptors = data.keyframes[node].descriptors
            assert descriptors is not None
            x, y = np.floor(data.poses[node, :2, 3] / SIZE).astype(int).tolist()
            assert tiles.like(pooled(descriptors), 1) == [(x, y)]
            assert tiles.like(pooled(descriptors), 60)[0] == (x, y)
            assert len(tiles.like(pooled(descriptors), 60)) == 4


def test_an_export_without_the_descriptors_in_memory_has_them(tmp_path: Path, folder: Path, data: MapData) -> None:
    save_as(data, tmp_path / "map")
    with MapStore.open(tmp_path / "map") as store:
        write_tiles(load_map(store, descriptors=False), tmp_path / "again", SIZE)
    np.testing.assert_array_equal(np.load(tmp_path / "again" / VECTORS), np.load(folder / VECTORS))


def test_what_is_wrong_is_named(tmp_path: Path, folder: Path, data: MapData) -> None:
    with pytest.raises(UsageError, match="is there already"):
        write_tiles(data, folder, SIZE)
    with pytest.raises(UsageError, match="tiles of nan m"):
        write_tiles(data, tmp_path / "other", float("nan"))
    with pytest.raises(UsageError, match="no folder of tiles"):
        TiledMap(tmp_path)
    tile = folder / "0_0.dpm2map"
    tile.write_bytes(tile.read_bytes()[:3000])
    with TiledMap(folder) as tiles, pytest.raises(Dpm2Error, match=r"0_0\.dpm2map"):
        tiles.read([(0, 0)])
    tile.unlink()
    with TiledMap(folder) as tiles, pytest.raises(Dpm2Error, match=r"0_0\.dpm2map: no such"):
        tiles.read([(0, 0)])
    assert not list(tmp_path.glob(".*"))


def test_what_can_be_read_is_searched_without_what_cannot(
    folder: Path, data: MapData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previously, one missing tile among the candidates hid all places in the others."""

    class Here:
        """Stand-in for a relocalizer: it finds everything or nothing."""

        def __init__(self, made: MapData) -> None:
            self.count = len(made)

        def find(self, *_: object) -> Registration:
            counts.append(self.count)
            return replace(Registration(np.eye(4), np.eye(6)), ok=found)

        verify = find

    keyframe, counts = data.keyframes[0], list[int]()
    (folder / "0_0.dpm2map").unlink()
    with TiledMap(folder) as tiles:
        monkeypatch.setattr("dpm2_core.slam.mapping.tiles.CANDIDATES", 60)  # from all tiles
        places = TiledRelocalizer(RelocalizationSettings(), tiles, Here, lambda _: keyframe.descriptors)  # type: ignore[arg-type,return-value]
        for found in (True, False):
            for ask in (places.find, lambda keyframe: places.verify(keyframe, np.eye(4))):
                if found:
                    assert ask(keyframe).ok
                else:
                    with pytest.raises(Dpm2Error, match=r"0_0\.dpm2map: no such map file"):
                        ask(keyframe)
    assert counts == [44] * 4  # of 59; 15 of them are in the missing tile


def test_a_full_disk_names_what_was_asked_for(tmp_path: Path) -> None:
    """The error does not name the hidden file or folder in which it was written."""
    data, out = ring(20, points=2000), tmp_path / "tiles"
    with largest_file(150_000), pytest.raises(Dpm2Error, match=rf"^{out}/0_0\.dpm2map: (?!.*\.part)"):
        write_tiles(data, out, SIZE)
    with largest_file(150_000), pytest.raises(Dpm2Error, match=rf"^{tmp_path / 'map'}: (?!.*\.part)"):
        save_as(data, tmp_path / "map")
    assert not list(tmp_path.iterdir())


def test_nobody_is_looked_for_in_tiles_without_descriptors(tmp_path: Path, folder: Path) -> None:
    """As for a single map without descriptors. Previously, the drive continued to its end and was never localized."""
    write_tiles(ring(20, points=50), tmp_path / "bare", SIZE)
    with pytest.raises(UsageError, match="bare: no keyframe has descriptors"):
        open_for_localization(tmp_path / "bare", SlamSettings())
    open_for_localization(folder, SlamSettings()).close()


@pytest.mark.parametrize(
    ("key", "value"),
    [("size", 0), ("size", "nan"), ("tiles", []), ("tiles", [[0, 0, 59.5, 1]]), ("tiles", [[0, 0, 1e300]]),
     ("tiles", [[0, 0, -1], [0, 1, 60]]), ("mean", [0.0]), ("mean", ["nan"] * 528), ("weights", None)],
)  # fmt: skip
def test_an_index_that_cannot_be_is_damaged(folder: Path, key: str, value: object) -> None:
    index = folder / INDEX
    index.write_text(json.dumps({**json.loads(index.read_text()), key: value}))
    with pytest.raises(Dpm2Error, match="index of its tiles is damaged"):
        TiledMap(folder)


def test_a_table_that_cannot_be_is_damaged(folder: Path) -> None:
    """Also a table that would be code."""
    for table in (np.zeros((59, 3), np.float32), np.zeros((59, 528)), np.array([print], dtype=object)):
        np.save(folder / VECTORS, table)
        with pytest.raises(Dpm2Error, match="index of its tiles is damaged"):
            TiledMap(folder)
    with (folder / VECTORS).open("wb") as file:
        np.savez(file, table=np.zeros(3))
    with pytest.raises(Dpm2Error, match="index of its tiles is damaged"):
        TiledMap(folder)
    (folder / VECTORS).write_bytes(b"")
    with pytest.raises(Dpm2Error, match="index of its tiles is damaged"):
        TiledMap(folder)


def test_an_index_without_end_is_damaged(folder: Path) -> None:
    (folder / INDEX).write_text("[" * 200_000)
    with pytest.raises(Dpm2Error, match="index of its tiles is damaged"):
        TiledMap(folder)
