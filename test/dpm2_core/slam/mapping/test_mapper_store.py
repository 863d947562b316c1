# SPDX-License-Identifier: Apache-2.0
"""Mapper and map file together: they agree, sessions are appended, clouds of laps do not accumulate, a full disk is
survived."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.errors import UsageError
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.mapper import Mapper, MapSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.full_disk import largest_file
from test.helpers.loops import KnownLoops
from test.helpers.maps import FIRM

LAP = 20
WRONG = LAP + 4  # a node with a wrong loop


def of_the_lap_before(node: int) -> list[Edge]:
    """Loop of each keyframe to the previous lap; every seventh is rejected."""
    if node < LAP:
        return []
    T = se3.exp([0, 0, 1e-4, 2e-3, 1e-3, 0])
    loop = Edge("loop", node - LAP, node, Registration(T, FIRM, 0.9, 0.05, "known"))
    return [loop if node % 7 else loop.rejected("no")]


def make(store: MapStore | None = None, **settings: object) -> Mapper:
    return Mapper(
        MapSettings.model_validate(settings), PoseGraph(RobustSettings()), KnownLoops(of_the_lap_before), store
    )


@contextmanager
def begun(path: Path, **settings: object) -> Iterator[Mapper]:
    """Mapper that writes a new session into a file, which is created if it does not exist."""
    with MapStore.open(path, read_only=False) if path.exists() else MapStore.create(path) as store:
        store.begin_session()
        yield make(store, **settings)


def laps(count: int, seed: int = 0) -> list[Keyframe]:
    rng = np.random.default_rng(seed)
    out: list[Keyframe] = []
    for i in range(count * LAP):
        T = se3.exp(np.array([0, 0, 1.0, 20, 0, 0]) * (2 * np.pi * i / LAP))
        edge = Registration(se3.inverse(out[-1].T_odom_kf) @ T, FIRM, 0.9, 0.05, "test") if i else None
        points = np.column_stack([rng.uniform(-30, 30, (500, 3)), rng.random(500)]).astype(np.float32)
        out.append(Keyframe(i, i * 10**8, i, T, points, edge))
    return out


def test_the_file_holds_what_the_mapper_holds(tmp_path: Path) -> None:
    path = tmp_path / "a.dpm2map"
    with begun(path) as mapper:
        for keyframe in laps(2):
            mapper.add(keyframe)
            assert mapper.store_problem == ""
        mapper.finish()
        clouds = list(mapper.clouds)
    with MapStore.open(path) as store:
        data = load_map(store)
        np.testing.assert_allclose(data.poses, mapper.poses, atol=1.1e-4)  # smaller corrections are not written
        assert len(data.constraints) == len(mapper.edges)
        assert sum(not edge.ok for edge in data.edges) == sum(not loop.ok for loop in mapper.loops) == 3
        again = make(store)
        assert len(again.keyframes) == again.session_start == 40
        for before, after in zip(clouds, again.clouds, strict=True):
            np.testing.assert_array_equal(after, before)


def one_wrong(node: int) -> list[Edge]:
    """The same loops, but one is far off and still accepted."""
    loops, wrong = of_the_lap_before(node), se3.exp([0, 0, 0.3, 9.0, 0, 0])
    if node != WRONG:
        return loops
    return [
        replace(loop, registration=replace(loop.registration, T_target_source=loop.T_from_to @ wrong)) for loop in loops
    ]


def test_the_file_has_the_verdicts_of_the_last_optimization(tmp_path: Path) -> None:
    """A loop that was accepted but that later ones contradict is no constraint in the file either."""
    path = tmp_path / "a.dpm2map"
    with MapStore.create(path) as store:
        store.begin_session()
        mapper = Mapper(MapSettings(), PoseGraph(RobustSettings()), KnownLoops(one_wrong), store)
        for keyframe in laps(2):
            mapper.add(keyframe)
        mapper.finish()
        assert mapper.store_problem == ""
    assert [loop.ok for loop in mapper.loops if loop.to_node == WRONG] == [True]
    with MapStore.open(path) as store:
        data = load_map(store)
    (wrong,) = (edge for edge in data.edges if (edge.kind, edge.to_node) == ("loop", WRONG))
    assert not wrong.ok
    assert "sigma" in wrong.registration.reason
    ends = {(edge.from_node, edge.to_node) for edge in data.constraints}
    assert ends == {(edge.from_node, edge.to_node) for edge in mapper.edges}
    assert len(data.edges) == len(mapper.loops) + 2 * LAP - 1


def again(node: int) -> bool:
    """Whether the loop of a keyframe, and the loop of the next lap to it, are accepted."""
    return node % 7 > 0 and (node + LAP) % 7 > 0


def test_the_file_keeps_how_a_place_was_last_seen(tmp_path: Path) -> None:
    """After three laps, the file contains the clouds of all keyframes of the last lap that borrow. Of the second lap it
    contains only those whose place was not found again."""
    path = tmp_path / "a.dpm2map"
    with begun(path) as mapper:
        for keyframe in laps(3):
            mapper.add(keyframe)
        clouds = mapper.clouds
        last = {loan.lender: node for node in range(3 * LAP) if (loan := clouds.loan(node))}
        packed = {node: clouds.packed(node) for node in range(3 * LAP) if clouds.keeps(node)}
    assert packed.keys() == {node for node in range(3 * LAP) if node not in range(LAP, 2 * LAP) or not again(node)}
    for file in (path, tmp_path / "copy"):
        with MapStore.open(file) as store:
            data = load_map(store)
            assert np.flatnonzero(data.clouds.kept).tolist() == sorted(packed)
            assert {node: store.payload(node, "cloud") for (node,) in store.rows("payloads", "node")} == packed
            assert not any(store.payload(node, "descriptors") for node in last.values())
            if file == path:
                save_as(data, tmp_path / "copy")
        assert not check_map(file).problems


@pytest.mark.slow
def test_four_laps_have_the_clouds_of_one(tmp_path: Path) -> None:
    """A keyframe whose loop was rejected keeps its own cloud: three in the second lap. Later keyframes borrow from
    these, too."""
    sizes = []
    for count in (1, 4):
        path = tmp_path / f"{count}.dpm2map"
        with begun(path) as mapper:
            for keyframe in laps(count):
                mapper.add(keyframe)
            own = sum(mapper.clouds.loan(node) is None for node in range(len(mapper.keyframes)))
        sizes.append((own, path.stat().st_size))
    (own_1, _), (own_4, _) = sizes
    assert own_1 == LAP
    rejected = sum(node % 7 == 0 for node in range(LAP, 4 * LAP))
    assert own_4 <= LAP + rejected
    off = make(redundancy=0.0)
    for keyframe in laps(2):
        off.add(keyframe)
    assert all(off.clouds.loan(node) is None for node in range(40))


def test_a_lap_is_tied_to_keyframes_that_have_clouds() -> None:
    """The search returns the previous lap, whose keyframes borrow. If three in ten loops lead from any lap to any other
    one, a graph of 4000 keyframes (one shift of a robot) takes 9 s to solve. With all loops to the first lap it takes
    0.8 s."""
    mapper, drive = make(), laps(4)
    for keyframe in drive:
        mapper.add(keyframe)
    mapper.finish()
    tied = [edge for edge in mapper.edges if edge.kind == "loop"]
    assert len(tied) == 3 * LAP - 9  # none for the multiples of 7 from 20 to 79
    assert all(mapper.clouds.loan(edge.from_node) is None for edge in tied)
    assert sum(edge.from_node < edge.to_node - LAP for edge in tied) > LAP
    for edge in tied:  # each step of a lap has an error of 2 mm
        off = se3.inverse(drive[edge.from_node].T_odom_kf) @ drive[edge.to_node].T_odom_kf
        assert se3.magnitude(se3.inverse(off) @ edge.T_from_to)[0] < 0.01


def test_a_borrowed_cloud_lies_where_the_loop_says(tmp_path: Path) -> None:
    mapper, keyframes = make(), laps(2)
    for keyframe in keyframes:
        mapper.add(keyframe)
    T_old_new = se3.exp([0, 0, 1e-4, 2e-3, 1e-3, 0])
    expected = se3.transform(se3.inverse(T_old_new), mapper.clouds[5])
    np.testing.assert_allclose(mapper.clouds[25], expected, atol=1e-4)
    far = make(redundancy=1e-3)
    for keyframe in keyframes:
        far.add(keyframe)
    assert far.clouds.loan(25) is None  # 2 mm apart


def test_a_second_session_counts_on(tmp_path: Path) -> None:
    path, drive = tmp_path / "a.dpm2map", laps(1)
    parts = drive[:8], drive[7:]  # the second part begins with the frame of the last keyframe
    for part in parts:
        with begun(path) as mapper:
            if mapper.keyframes:
                mapper.start_session(None, FIRM)
            for number, keyframe in enumerate(part):
                edge = keyframe.edge if number else None
                mapper.add(Keyframe(number, keyframe.stamp, keyframe.index, keyframe.T_odom_kf, keyframe.cloud, edge))
    with MapStore.open(path) as store:
        data = load_map(store)
        assert [k.id for k in data.keyframes] == list(range(LAP + 1))
        assert [k.session for k in data.keyframes] == [1] * 8 + [2] * 13
        np.testing.assert_allclose(data.poses, [k.T_odom_kf for part in parts for k in part], atol=1e-6)
        assert len([e for e in data.edges if e.kind == "odometry"]) == LAP


def test_a_session_that_goes_on_with_the_frame_of_a_keyframe_begins_where_it_is(tmp_path: Path) -> None:
    """The start of the odometry does not matter. It is level if an IMU measures gravity: previously, a tilted LiDAR was
    then tilted twice."""
    path, drive = tmp_path / "a.dpm2map", laps(1)
    with begun(path) as mapper:
        for keyframe in drive[:8]:
            mapper.add(keyframe)
    with begun(path) as mapper:
        mapper.start_session(None, FIRM)
        assert mapper.T_map_odom is None
        T_odom_first = se3.exp([0, 0.1, 0, 0, 0, 0])
        mapper.add(replace(drive[7], id=0, T_odom_kf=T_odom_first, edge=None))
        np.testing.assert_allclose(mapper.poses[8], mapper.poses[7], atol=1e-9)
        assert mapper.T_map_odom is not None
        np.testing.assert_allclose(mapper.T_map_odom @ T_odom_first, mapper.poses[7], atol=1e-9)


def test_a_file_that_is_moved_away_is_said_and_still_written(tmp_path: Path) -> None:
    """Previously, all reports said that the map was saved in a file that did not exist."""
    path, elsewhere = tmp_path / "town.dpm2map", tmp_path / "elsewhere.dpm2map"
    with begun(path) as mapper:
        mapper.add(laps(1)[0])
        mapper.finish()
        assert mapper.store_problem == ""
        path.rename(elsewhere)
        mapper.add(laps(1)[1])
        mapper.finish()
        assert mapper.store_problem == f"{path}: removed or moved since it was opened"
        path.write_bytes(b"another file")
        mapper.finish()
        assert "removed or moved" in mapper.store_problem
        path.unlink()
        elsewhere.rename(path)
        mapper.finish()
        assert mapper.store_problem == ""
    with MapStore.open(path) as store:
        assert store.size == 2


@pytest.mark.slow
def test_a_full_disk_is_survived_and_the_file_catches_up(tmp_path: Path) -> None:
    """For ten keyframes, no file may be larger than the map's log before them plus 10 kB."""
    path, room, problems = tmp_path / "a.dpm2map", 0, list[str]()
    with begun(path) as mapper:
        for number, keyframe in enumerate(laps(1)):
            if number == 5:
                room = Path(f"{path}-wal").stat().st_size + 10000
            with largest_file(room) if 5 <= number < 15 else nullcontext():
                mapper.add(keyframe)
                problems.append(mapper.store_problem)
                assert len(mapper.clouds[number]) == 500
        assert not any(problems[:5]), problems
        assert all(problems[8:15])
        assert str(path) in problems[10]
        assert "in memory only" in problems[10]
        assert len(problems[10].splitlines()) == 1
        assert not any(problems[15:]), problems
        assert len(mapper.cloud())
    with MapStore.open(path) as store:
        data = load_map(store)
        assert (len(data), len(data.edges)) == (20, 19)


def test_memory_of_a_keyframe_is_that_of_its_descriptors(tmp_path: Path) -> None:
    """Packed clouds take 8 kB per keyframe, 2 MB in total. Without descriptors, far less remains in memory."""
    import tracemalloc

    drive = laps(3)
    with begun(tmp_path / "a.dpm2map", moving_window=0) as mapper:
        for keyframe in drive[:LAP]:
            mapper.add(keyframe)
        tracemalloc.start()
        for keyframe in drive[LAP:]:
            mapper.add(keyframe)
        used, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert used / (2 * LAP) < 8000


def test_descriptors_that_the_network_cannot_compare_are_told(map_file: Path) -> None:
    """Descriptors of 16 channels, whatever weights the file names. Every search for loops would fail with them."""

    class Network(KnownLoops):
        channels = 128

    for read_only in (True, False):
        with MapStore.open(map_file, read_only) as store:
            with pytest.raises(UsageError, match="descriptors of 16 channels, the network makes 128") as caught:
                Mapper(MapSettings(), PoseGraph(RobustSettings()), Network(of_the_lap_before), store)
            assert str(map_file) in str(caught.value)
