# SPDX-License-Identifier: Apache-2.0
"""A map grows by a drive: the result equals a full solution, costs only what the drive touches, and is all or
nothing."""

from __future__ import annotations

import os
import signal
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Registration
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.fleet.growth import Growth, Standing, add_drives, grown, joins_of
from dpm2_core.fleet.regions import LARGEST, Join, solve
from dpm2_core.frame import Fix, Georeference
from dpm2_core.geometry import geodesy, se3
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import MapData, load_map
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.fleets import drive_map, fleet_maps
from test.helpers.maps import FIRM

SETTINGS = RobustSettings()


def _made(path: Path, maps: Mapping[str, MapData], joins: Sequence[Join]) -> dict[str, int]:
    """Make a map file of drives, solved at once; returns the number of keyframes of each."""
    region = solve(maps, joins, SETTINGS)
    with MapStore.create(path) as store:
        add_drives(store, {}, Growth({name: _at(maps[name], T) for name, T in region.poses.items()}, region.joins))
    return {name: len(data) for name, data in maps.items()}


def _at(data: MapData, poses: np.ndarray) -> MapData:
    return replace(data, poses=poses)


def _of(joins: Sequence[Join], names: Sequence[str]) -> list[Join]:
    return [join for join in joins if join.one in names and join.other in names]


def _standing(store: MapStore, inside: Mapping[str, int], largest: int = LARGEST) -> Standing:
    return Standing(store, inside, list(pairwise(sorted(inside))), SETTINGS, largest)


def _poses(path: Path) -> np.ndarray:
    with MapStore.open(path) as store:
        return load_map(store).poses


def test_drives_one_by_one_come_to_lie_where_all_at_once_would_put_them(tmp_path: Path) -> None:
    """This includes a drive with joins to the map only through another new one; false joins are rejected; the file is
    sound."""
    _, maps, joins = fleet_maps(6)
    names = list(maps)
    whole, path = solve(maps, joins, SETTINGS), tmp_path / "map"
    inside = _made(path, {name: maps[name] for name in names[:2]}, _of(joins, names[:2]))
    for new in (["d2"], ["d4", "d3"], ["d5"]):
        there = [*inside, *new]
        between = [join for join in _of(joins, there) if not {join.one, join.other} <= set(inside)]
        with MapStore.open(path, read_only=False) as store:
            growth = grown(_standing(store, inside), {name: maps[name] for name in new}, between)
            assert growth is not None
            assert {(j.loop.from_node, j.loop.to_node) for j in growth.joins if not j.loop.ok} == {(5, 5)}
            add_drives(store, inside, growth)
        inside |= {name: len(maps[name]) for name in growth.maps}
    assert not check_map(path).problems
    np.testing.assert_allclose(_poses(path), np.concatenate([whole.poses[name] for name in inside]), atol=0.05)
    with MapStore.open(path) as store:
        data = load_map(store)
    assert [k.robot for k in data.keyframes[::60]] == list(inside)
    assert len({k.session for k in data.keyframes}) == 6
    found = joins_of([edge for edge in data.edges if edge.kind == "loop"], inside)
    assert sorted((j.one, j.other, j.loop.ok) for j in found) == sorted(
        (j.one, j.other, (j.loop.from_node, j.loop.to_node) != (5, 5)) for j in joins
    )


def test_what_a_new_drive_does_not_touch_is_neither_read_nor_moved(tmp_path: Path) -> None:
    """Of 20 drives, one at the end is added; the rows of far ones are damaged, which any reader would report."""
    _, maps, joins = fleet_maps(20)
    names, path = list(maps), tmp_path / "map"
    inside = _made(path, {name: maps[name] for name in names[:-1]}, _of(joins, names[:-1]))
    with closing(sqlite3.connect(path)) as sql, sql:
        sql.execute("UPDATE poses SET crc = crc + 1 WHERE node < 900")
        sql.execute("UPDATE edges SET crc = crc + 1 WHERE from_node < 900 AND to_node < 900")
    with MapStore.open(path, read_only=False) as store:
        growth = grown(_standing(store, inside), {"d19": maps["d19"]}, joins[-11:])
    assert growth is not None
    assert min(growth.moved, default=10**6) >= 900, "a far drive was moved"


def test_a_drive_that_meets_hundreds_of_others_is_added(tmp_path: Path) -> None:
    """A road to a depot, for example, meets hundreds of drives. Previously, SQLite accepted no query about more than
    500."""
    poses, names, path = fleet_maps(1)[0]["d0"][:3], [f"d{number:03}" for number in range(502)], tmp_path / "map"
    maps = {name: _at(drive_map(poses, number), poses) for number, name in enumerate(names)}
    same = Registration(np.eye(4), FIRM)
    joins = [Join(one, other, Edge("loop", k, k, same)) for one, other in pairwise(names) for k in range(3)]
    *there, new = names
    inside = dict.fromkeys(there, 3)
    with MapStore.create(path) as store:
        with store.together():
            add_drives(store, {}, Growth({name: maps[name] for name in there}, _of(joins, there)))
        met = [Join(name, new, Edge("loop", k, k, same)) for name in there for k in range(3)]
        growth = grown(_standing(store, inside), {new: maps[new]}, met)
    assert growth is not None
    assert list(growth.maps) == [new]


def test_a_kill_while_a_drive_is_written_leaves_the_map_as_it_was(tmp_path: Path) -> None:
    _, maps, joins = fleet_maps(3)
    path = tmp_path / "map"
    inside = _made(path, {name: maps[name] for name in ("d0", "d1")}, _of(joins, ["d0", "d1"]))
    before = _poses(path)
    child = get_context("fork").Process(target=_killed, args=(path, inside, maps["d2"], joins[11:]))
    child.start()
    child.join(60)
    assert child.exitcode == -signal.SIGKILL
    with MapStore.open(path, read_only=False) as store:
        assert store.size == 120
    np.testing.assert_array_equal(_poses(path), before)
    assert not check_map(path).problems


def _killed(path: Path, inside: Mapping[str, int], data: MapData, joins: Sequence[Join]) -> None:
    store = MapStore.open(path, read_only=False)
    growth = grown(_standing(store, inside), {"d2": data}, joins)
    assert growth is not None
    with store.together():
        add_drives(store, inside, growth)
        assert store.size == 180
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    "damage",
    ["UPDATE poses SET T_map_kf = zeroblob(128) WHERE node = 3", "DELETE FROM poses WHERE node = 3",
     "UPDATE edges SET T_from_to = zeroblob(128) WHERE id = 1"],
)  # fmt: skip
def test_a_damaged_map_is_an_error_that_names_it(tmp_path: Path, damage: str) -> None:
    _, maps, joins = fleet_maps(3)
    names, path = list(maps), tmp_path / "town.dpm2map"
    inside = _made(path, {name: maps[name] for name in names[:2]}, _of(joins, names[:2]))
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(damage)
    with MapStore.open(path) as store, pytest.raises(Dpm2Error, match=r"town\.dpm2map: .*; see dpm2 map check"):
        grown(_standing(store, inside), {names[2]: maps[names[2]]}, joins)


def test_a_ring_that_closes_moves_what_it_must(tmp_path: Path) -> None:
    """A last drive connects the first to the last: all drives in between are moved, as in a full solution."""
    truth, maps, joins = fleet_maps(6, turn=2 * np.pi / 240)
    names, path = list(maps), tmp_path / "map"
    T = se3.inverse(truth["d0"][:20]) @ truth["d5"][40:]
    around = [Join("d0", "d5", Edge("loop", k, 40 + k, Registration(T[k], FIRM))) for k in range(0, 20, 2)]
    inside = _made(path, {name: maps[name] for name in names[:-1]}, _of(joins, names[:-1]))
    with MapStore.open(path, read_only=False) as store:
        growth = grown(_standing(store, inside), {"d5": maps["d5"]}, [*joins[-11:], *around])
        assert growth is not None
        add_drives(store, inside, growth)
    whole = solve(maps, [*joins, *around], SETTINGS)
    assert sum(join.loop.ok for join in growth.joins) == 20
    assert ape_rmse(np.concatenate(list(whole.poses.values())), _poses(path)) < 0.05  # m, of 480 m


def test_a_drive_that_the_map_contradicts_stays_out(tmp_path: Path) -> None:
    """Its joins agree with two different places of the map: either none of both remain, or the remaining ones are
    right."""
    _, maps, joins = fleet_maps(3)
    path = tmp_path / "map"
    inside = _made(path, {name: maps[name] for name in ("d0", "d1")}, _of(joins, ["d0", "d1"]))
    few = [join for join in joins[11:] if join.loop.ok][:2]
    wrong = [
        Join("d0", "d2", Edge("loop", 7 * k, 59 - k, Registration(se3.exp(np.eye(6)[3] * k), FIRM))) for k in range(4)
    ]
    with MapStore.open(path, read_only=False) as store:
        growth = grown(_standing(store, inside), {"d2": maps["d2"]}, [*few, *wrong])
    assert growth is not None
    assert not growth.maps
    assert len(growth.joins) == 6
    assert not any(join.loop.ok for join in growth.joins)


def test_what_is_too_large_to_be_solved_at_once_is_made_anew(tmp_path: Path) -> None:
    _, maps, joins = fleet_maps(3)
    path = tmp_path / "map"
    inside = _made(path, {name: maps[name] for name in ("d0", "d1")}, _of(joins, ["d0", "d1"]))
    with MapStore.open(path, read_only=False) as store:
        assert grown(_standing(store, inside, 119), {"d2": maps["d2"]}, joins[11:]) is None
        with pytest.raises(KeyError):
            grown(_standing(store, inside), {"d2": maps["d2"]}, [Join("d9", "d2", joins[11].loop)])


ORIGIN = np.array([49.0, 8.4, 110.0])


def _with_fixes(data: MapData, true: np.ndarray) -> MapData:
    """The map of a drive with a fix at each of its true poses (N, 4, 4) about ORIGIN, and with its georeference."""
    places = geodesy.geodetic((geodesy.enu_frame(ORIGIN) @ true)[:, :3, 3])
    fixes = [Fix(i, place, np.eye(3) * 0.02**2, np.zeros(3)) for i, place in enumerate(places)]
    keyframes = [replace(keyframe, fix=fix) for keyframe, fix in zip(data.keyframes, fixes, strict=True)]
    return replace(data, keyframes=keyframes, georeference=Georeference(ORIGIN, true[0] @ se3.inverse(data.poses[0])))


@pytest.mark.parametrize("late", [False, True])
def test_a_map_takes_over_where_it_is_from_the_first_drive_that_knows(tmp_path: Path, late: bool) -> None:
    """The first two of three drives have none; `late`: the third is added to an existing map."""
    truth, maps, joins = fleet_maps(3)
    maps["d2"] = _with_fixes(maps["d2"], truth["d2"])
    names, path = list(maps), tmp_path / "map"
    first = names[:2] if late else names
    region = solve({name: maps[name] for name in first}, _of(joins, first), SETTINGS)
    solved = {name: replace(maps[name], poses=T) for name, T in region.poses.items()}
    with MapStore.create(path) as store:
        add_drives(store, {}, Growth(solved, region.joins))
        if late:
            inside = {name: len(maps[name]) for name in first}
            growth = grown(_standing(store, inside), {"d2": maps["d2"]}, joins[11:])
            assert growth is not None
            add_drives(store, inside, growth)
    with MapStore.open(path) as store:
        data = load_map(store)
    assert data.georeference is not None
    T_ecef_map = geodesy.enu_frame(data.georeference.origin) @ data.georeference.T_enu_map
    own = se3.inverse(geodesy.enu_frame(ORIGIN)) @ T_ecef_map @ data.poses[120:]
    off = np.linalg.norm((own - truth["d2"])[:, :2, 3], axis=1)
    assert off.max() < 1.0  # m: the odometry of 120 m has drifted, by 1 mrad per keyframe
