# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map` and `dpm2 run --map` on real files; their output is read back by other means."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.open import open_source
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.fleet.regions import side_by_side, solve
from dpm2_core.frame import Array, Georeference
from dpm2_core.geometry import se3
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, LidarConfig
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.mapping.merge import merge_maps, optimized
from dpm2_core.slam.mapping.prune import prune
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore
from dpm2_core.slam.store.map_data import MapData, load_map, save_as, ways
from dpm2_core.slam.store.map_store import Change, MapStore

from ...helpers.command import dpm2, refused, started, succeeded
from ...helpers.fleets import fleet_maps
from ...helpers.maps import ring


def loaded(path: Path) -> MapData:
    with MapStore.open(path) as store:
        return load_map(store)


def test_info(map_file: Path) -> None:
    done = succeeded("map", "info", map_file)
    info = " ".join(done.stdout.split())
    for words in (
        "12, 12 of them",
        "12 with descriptors",
        "1 accepted of 2 tried",
        "kB per keyframe",
        "small 0123456789",
    ):
        assert words in info, info


def test_trajectories_and_graph(tmp_path: Path, map_file: Path, keyframes: list[Keyframe]) -> None:
    import gtsam

    poses = np.array([k.T_odom_kf for k in keyframes])
    for name in ("a.tum", "a.g2o"):
        assert dpm2("map", "export", map_file, tmp_path / name).returncode == 0
    assert dpm2("map", "export", map_file, tmp_path / "kitti.txt", "--format", "kitti").returncode == 0
    tum, kitti = read_trajectory(tmp_path / "a.tum"), read_trajectory(tmp_path / "kitti.txt")
    assert list(tum.keys) == [k.stamp for k in keyframes]
    np.testing.assert_allclose(tum.poses, poses, atol=1e-9)
    np.testing.assert_allclose(kitti.poses, poses, atol=1e-9)
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
    assert factors.size() == 12  # 11 of odometry and the accepted loop
    np.testing.assert_allclose(values.atPose3(11).matrix(), poses[11], atol=1e-9)


def test_clouds_agree_in_every_format(tmp_path: Path, map_file: Path) -> None:
    for ending in ("ply", "pcd"):
        assert dpm2("map", "export", map_file, tmp_path / f"a.{ending}", "--voxel", 1.0).returncode == 0
    ply = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[2]
    pcd = (tmp_path / "a.pcd").read_bytes().partition(b"DATA binary\n")[2]
    assert ply == pcd
    points = np.frombuffer(ply, "<f4").reshape(-1, 4)
    assert len(points) > 3000
    assert len(np.unique(np.floor(points[:, :3]).astype(int), axis=0)) == len(points)


def test_occupancy(tmp_path: Path, map_file: Path) -> None:
    assert dpm2("map", "export", map_file, tmp_path / "grid.yaml", "--resolution", 0.5).returncode == 0
    assert {p.name for p in tmp_path.glob("grid.*")} == {"grid.yaml", "grid.pgm"}


def test_a_grid_of_a_map_that_is_not_level_is_said_to_be_of_no_use(tmp_path: Path, recording: Path) -> None:
    """A warning is given for a LiDAR that is tilted in a drive without an IMU: the road is then full of obstacles."""
    scene = next(iter(open_source(recording).frames())).points[::4]
    for name, degrees in (("level", 0), ("tilted", 25)):
        data, T_tilted_level = ring(6), se3.exp([0, np.radians(degrees), 0, 0, 0, 0])
        clouds = CloudStore()
        for _ in range(6):
            clouds.append(pack_cloud(se3.transform(T_tilted_level, scene)))
        poses = T_tilted_level @ data.poses @ se3.inverse(T_tilted_level)
        save_as(replace(data, clouds=clouds, poses=poses), tmp_path / f"{name}.dpm2map")
        done = succeeded("map", "export", tmp_path / f"{name}.dpm2map", tmp_path / f"{name}.yaml", "--resolution", 0.5)
        assert ("the ground of the map is tilted by 2" in done.stderr) == (degrees > 0), done.stderr
        assert (tmp_path / f"{name}.pgm").is_file()


def test_a_grid_of_storeys_that_lie_over_each_other_is_said_to_be_of_no_use(tmp_path: Path) -> None:
    """Obstacles on one floor are free where the other is seen through: both share one grid. A steep hill is no
    problem."""
    data = ring(40, 100)  # around 200 m
    for name, slope, laps, words in (("hill", 0.2, 1, ""), ("house", 0.0, 2, "up to 2.8 m above each other")):
        poses = np.repeat(data.poses[None], laps, 0)
        poses[..., 2, 3] += slope * poses[..., 0, 3] + 2.8 * np.arange(laps)[:, None]
        both = data if laps == 1 else merge_maps(data, data, np.eye(4), [data.edges[0]])
        save_as(replace(both, poses=poses.reshape(-1, 4, 4)), tmp_path / f"{name}.dpm2map")
        done = succeeded("map", "export", tmp_path / f"{name}.dpm2map", tmp_path / f"{name}.yaml", "--resolution", 0.5)
        assert ("do not use it" in done.stderr, words in done.stderr) == (bool(words), True), done.stderr
        assert (tmp_path / f"{name}.pgm").is_file()


def test_an_export_replaces_neither_the_map_nor_another_grid(tmp_path: Path, map_file: Path) -> None:
    before = map_file.read_bytes()
    done = dpm2("map", "export", map_file, map_file, "--format", "ply")
    assert (done.returncode, "is the input map" in done.stderr) == (2, True)
    assert map_file.read_bytes() == before
    assert dpm2("map", "export", map_file, tmp_path / "site-1.5", "--format", "occupancy").returncode == 0
    assert {path.name for path in tmp_path.glob("site*")} == {"site-1.5.yaml", "site-1.5.pgm"}
    done = dpm2("map", "export", map_file, tmp_path / "a.ply", "--voxel", "inf")
    assert (done.returncode, (tmp_path / "a.ply").exists()) == (2, False)


def test_maps_of_different_weights_are_not_merged(tmp_path: Path, map_file: Path) -> None:
    """This is an error, since no robot could localize in the result."""
    other = tmp_path / "other.dpm2map"
    other.write_bytes(map_file.read_bytes())
    with closing(sqlite3.connect(other)) as connection:
        connection.execute("UPDATE sessions SET weights = 'mine fedcba9876543210'")
        connection.commit()
    error = refused("map", "merge", map_file, other, "--out", tmp_path / "both.dpm2map", "--transform", "9 0 0 0")
    assert "mine fedcba9876543210, small 0123456789" in error
    assert not (tmp_path / "both.dpm2map").exists()


def test_what_cannot_be_exported(tmp_path: Path, map_file: Path) -> None:
    assert "choose --format from ply, pcd" in refused("map", "export", map_file, tmp_path / "a.jpg")
    with MapStore.create(tmp_path / "empty.dpm2map") as store:
        store.begin_session()
    assert "no keyframe" in refused("map", "export", tmp_path / "empty.dpm2map", tmp_path / "a.ply")
    assert dpm2("map", "info", tmp_path / "empty.dpm2map").returncode == 0


def test_an_empty_map_makes_no_tiles(tmp_path: Path) -> None:
    with MapStore.create(tmp_path / "empty.dpm2map") as store:
        store.begin_session()
    error = refused("map", "export", tmp_path / "empty.dpm2map", tmp_path / "tiles", "--tiles", 50)
    assert error.strip().endswith("empty.dpm2map: the map has no keyframes")
    assert not (tmp_path / "tiles").exists()


def test_the_graph_of_several_drives_lies_where_their_map_does(tmp_path: Path) -> None:
    """This holds although the first loop between two of them is wrong, and the optimization has rejected it."""
    import gtsam

    _, maps, joins = fleet_maps(2)
    joins.insert(0, joins.pop())  # the wrong one first
    poses = solve(maps, joins, RobustSettings()).poses
    data = replace(side_by_side(maps, joins), poses=np.concatenate(list(poses.values())))
    save_as(data, tmp_path / "map")
    assert dpm2("map", "export", tmp_path / "map", tmp_path / "a.g2o").returncode == 0
    _, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
    written = np.array([values.atPose3(node).matrix() for node in range(len(data))])
    np.testing.assert_allclose(written, data.poses, atol=1e-9)  # rounding


def test_the_length_is_that_of_all_ways(tmp_path: Path) -> None:
    """Two robots have alternating keyframes; the length is the same if keyframes are pruned. The file may be a link."""
    steps = 10.0 * np.arange(12)
    made = ring(24, points=10)
    poses = np.array([se3.make(np.eye(3), [steps[node // 2], 100.0 * (node % 2), 0]) for node in range(24)])
    robots = [replace(k, robot=("red", "blue")[k.id % 2]) for k in made.keyframes]
    edges = [
        Edge("odometry", node - 2, node, Registration(se3.inverse(poses[node - 2]) @ poses[node], np.eye(6) * 1e-4))
        for node in range(2, 24)
    ]
    data = replace(made, poses=poses, keyframes=robots, edges=edges)
    save_as(data, tmp_path / "whole")
    save_as(prune(data, range(3, 20)), tmp_path / "less")
    for name in ("whole", "less"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(tmp_path / name)
        with MapStore.open(tmp_path / name, read_only=False) as store:
            store.begin_session()  # from now on there is a file next to it
            succeeded("map", "info", tmp_path / "link", "--json", tmp_path / f"{name}.json")
            size = sum(path.stat().st_size for path in (tmp_path / name, tmp_path / f"{name}-wal"))
        figures = json.loads((tmp_path / f"{name}.json").read_text())
        assert figures["length_m"] == pytest.approx(2 * 110.0)
        assert figures["bytes"] == size


def test_two_drives_of_a_session_are_two_ways(tmp_path: Path) -> None:
    """If the odometry starts again in a session, as for a recording that is played again, there are two trajectories.
    Previously, the 1 km from the end of one to the start of the other counted as length, and was a line on the page and
    in GeoJSON."""
    both = side_by_side({"one": ring(12), "two": ring(12)}, [])
    poses = both.poses.copy()
    poses[12:, 0, 3] += 1000
    again = [replace(k, id=node, robot="", session=1) for node, k in enumerate(both.keyframes)]
    save_as(replace(both, keyframes=again, poses=poses), tmp_path / "map")
    assert dpm2("map", "info", tmp_path / "map", "--json", tmp_path / "info.json").returncode == 0
    one = np.linalg.norm(np.diff(ring(12).poses[:, :3, 3], axis=0), axis=1).sum()
    assert json.loads((tmp_path / "info.json").read_text())["length_m"] == pytest.approx(2 * one)
    assert [len(way.stamps) for way in ways(loaded(tmp_path / "map"))] == [12, 12]


def test_merge_by_transform(tmp_path: Path, map_file: Path) -> None:
    out = tmp_path / "both.dpm2map"
    assert dpm2("map", "merge", map_file, map_file, "--out", out, "--transform", "10 0 0 90").returncode == 0
    both = loaded(out)
    T = se3.make([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [10, 0, 0])
    np.testing.assert_allclose(both.poses[12:], T @ both.poses[:12], atol=1e-9)
    for words in (["--transform", "1 2 3"], 2 * ["--transform", "0 0 0 0"], ["--transform", "a b c d"]):
        refused("map", "merge", map_file, map_file, "--out", tmp_path / "no", *words)
    error = refused("map", "merge", map_file, map_file, "--out", out, "--transform", "0 0 0 0")
    assert "a file already" in error


def test_a_drive_that_both_maps_hold_is_said_to_be_there_twice(tmp_path: Path) -> None:
    """Drives that only begin at the same time and pose, as those of a simulator do, are not reported."""
    one = ring(12)
    moved = [replace(k, T_odom_kf=k.T_odom_kf @ se3.exp([0, 0, 0, 0.1 * n, 0, 0])) for n, k in enumerate(one.keyframes)]
    save_as(one, tmp_path / "one")
    save_as(replace(one, keyframes=moved), tmp_path / "other")
    for second, said in (("one", True), ("other", False)):
        both = tmp_path / f"with {second}"
        done = succeeded("map", "merge", tmp_path / "one", tmp_path / second, "--out", both, "--transform", "10 0 0 90")
        assert ("12 of its 12 keyframes are also in an earlier map" in done.stderr) is said
        assert len(loaded(both)) == 24


def test_the_trajectory_of_several_drives_begins_with_the_earliest(tmp_path: Path) -> None:
    early = ring(12)
    late = replace(early, keyframes=[replace(k, stamp=k.stamp + 10**12) for k in early.keyframes])
    save_as(late, tmp_path / "late")
    save_as(early, tmp_path / "early")
    both = tmp_path / "both"
    succeeded("map", "merge", tmp_path / "late", tmp_path / "early", "--out", both, "--transform", "9 0 0 0")
    assert dpm2("map", "export", both, tmp_path / "a.tum").returncode == 0
    keys = list(read_trajectory(tmp_path / "a.tum").keys)
    assert keys == sorted(k.stamp for k in (*early.keyframes, *late.keyframes))


def test_merge_by_transform_keeps_the_place_on_earth_of_either_map(tmp_path: Path, map_file: Path) -> None:
    plain, out = tmp_path / "plain.dpm2map", tmp_path / "both.dpm2map"
    plain.write_bytes(map_file.read_bytes())
    known = Georeference(np.array([49.0, 8.4, 110.0]), se3.exp(np.array([0, 0, 1.0, 2, 3, 4])))
    with MapStore.open(map_file, read_only=False) as store:
        store.write(Change(georeference=known))
    for first, second, place in ((plain, map_file, slice(12, None)), (map_file, plain, slice(0, 12))):
        out.unlink(missing_ok=True)
        assert dpm2("map", "merge", first, second, "--out", out, "--transform", "10 0 0 90").returncode == 0
        both = loaded(out)
        np.testing.assert_array_equal(both.georeference.origin, known.origin)
        where = known.T_enu_map @ loaded(map_file).poses
        np.testing.assert_allclose(both.georeference.T_enu_map @ both.poses[place], where, atol=1e-9)
    info = dpm2("map", "info", out, "--json", tmp_path / "info.json")
    assert "its accuracy is not known" in " ".join(info.stdout.split())
    figures = json.loads((tmp_path / "info.json").read_text(), parse_constant=pytest.fail)["georeference"]
    assert (figures["heading_sigma_deg"], figures["position_sigma_m"], figures["fixes"]) == (None, None, 0)


def test_merge_by_a_transform_that_the_fixes_contradict_says_so(tmp_path: Path, map_file: Path) -> None:
    """A warning is given, for example, for a wrong sign, or if the two maps are exchanged."""
    with MapStore.open(map_file, read_only=False) as store:
        store.write(Change(georeference=Georeference(np.array([49.0, 8.4, 110.0]), se3.exp([0, 0, 1.0, 2, 3, 4]))))
    for words, said in (("500 0 0 0", "500 m from its pose by the fixes of both maps"), ("1 0 0 0", "")):
        out = tmp_path / f"{words}.dpm2map"
        done = succeeded("map", "merge", map_file, map_file, "--out", out, "--transform", words)
        assert (said in done.stderr, "fixes" in done.stderr) == (True, bool(said))


def points_of(ply: Path) -> Array:
    """(M, 3) points, m."""
    return np.frombuffer(ply.read_bytes().partition(b"end_header\n")[2], "<f4").reshape(-1, 4)[:, :3]


@pytest.mark.parametrize("robots", [("", ""), ("red", "blue")])
def test_what_nothing_ties_to_the_first_keyframe_is_left_out_and_named(tmp_path: Path, robots: tuple[str, str]) -> None:
    """Neither a second drive nor a second robot is drawn at the first one's poses; pruned keyframes remain with those
    that have their place."""
    one = ring(12)
    two = merge_maps(one, one, np.eye(4))
    keyframes = [replace(k, robot=robots[node // 12]) for node, k in enumerate(two.keyframes)]
    if robots[1]:
        keyframes = [replace(k, session=1) for k in keyframes]
    apart = prune(replace(two, keyframes=keyframes), [5, 18])
    alone = prune(replace(one, keyframes=keyframes[:12]), [5])
    save_as(apart, tmp_path / "apart")
    save_as(alone, tmp_path / "alone")
    drive = "session 1 of blue" if robots[1] else "session 2"
    for name in ("a.ply", "a.pcd", "a.html", "a.pgm", "a.tum"):
        for path in ("apart", "alone"):
            done = succeeded("map", "export", tmp_path / path, tmp_path / f"{path}.{name}")
            assert (f"12 of the 12 keyframes of {drive} are left out: no loop connects" in done.stderr) == (
                path == "apart"
            )
        if name != "a.html":  # the page has a title
            assert (tmp_path / f"apart.{name}").read_bytes() == (tmp_path / f"alone.{name}").read_bytes()
    assert len(read_trajectory(tmp_path / "apart.a.tum").keys) == 12


def test_maps_that_are_joined_by_a_known_transform_stay_together(tmp_path: Path) -> None:
    """No loop ties them, but the clouds of both are present, and the graph keeps the transform."""
    save_as(ring(12), tmp_path / "one")
    succeeded("map", "merge", tmp_path / "one", tmp_path / "one", "--out", tmp_path / "both",
                "--transform", "600 0 0 0")  # fmt: skip
    done = dpm2("map", "export", tmp_path / "both", tmp_path / "both.ply")
    assert "without" not in done.stderr
    points = points_of(tmp_path / "both.ply")
    far = points[:, 0] > 300
    assert far.sum() == pytest.approx((~far).sum(), rel=0.01)  # a point between two voxels may be rounded into either
    both = loaded(tmp_path / "both")
    np.testing.assert_allclose(optimized(both, PoseGraph(RobustSettings())).poses, both.poses, atol=1e-6)


def test_check_and_recover(tmp_path: Path, map_file: Path) -> None:
    done = succeeded("map", "check", map_file)
    assert "no damage" in done.stdout
    content = bytearray(map_file.read_bytes())
    content[-3000:-100] = bytes(2900)
    map_file.write_bytes(content)
    done = dpm2("map", "check", map_file)
    assert done.returncode == 1
    assert "--recover" in done.stderr
    assert dpm2("map", "check", map_file, "--recover", tmp_path / "good.dpm2map").returncode == 0
    assert dpm2("map", "check", tmp_path / "good.dpm2map").returncode == 0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lap of 60 frames."""
    folder = tmp_path_factory.mktemp("drive") / "drive"
    simulate(
        folder,
        DriveConfig(
            frames=60, seed=3, road="loop", preset="suburb", images=False, lidar=LidarConfig(beams=32, columns=512)
        ),
    )
    return folder


def aligned(data: MapData) -> dict[int, Array]:
    return {k.index: T for k, T in zip(data.keyframes, data.poses, strict=True)}


RUN = ("--set", "slam.loops.descriptors=false", "--set", "slam.registration=geometric")


@pytest.mark.slow
def test_run_writes_a_map_and_goes_on_with_it(tmp_path: Path, recording: Path) -> None:
    whole, parts = tmp_path / "whole.dpm2map", tmp_path / "parts.dpm2map"
    assert dpm2("run", recording, "--out", tmp_path / "a", "--map", whole, *RUN).returncode == 0
    assert dpm2("run", recording, "--out", tmp_path / "b", "--map", parts, "--frames", "0:35", *RUN).returncode == 0
    before = len(loaded(parts))
    error = refused("run", recording, "--out", tmp_path / "b", "--map", parts, *RUN)
    assert "--resume goes on with its drive, --extend adds another" in error
    done = succeeded("run", recording, "--out", tmp_path / "b", "--map", parts, "--resume", *RUN)
    first = loaded(parts).keyframes[before - 1].index
    assert f"before_{first}: the results of the interrupted run; this run begins at frame {first}" in done.stderr
    assert len(read_trajectory(tmp_path / "b" / f"before_{first}" / "trajectory.tum")) == 35
    assert (tmp_path / "b" / f"before_{first}" / "metrics.json").exists()
    one, two = loaded(whole), loaded(parts)
    assert {k.session for k in two.keyframes} == {1, 2}
    assert two.keyframes[before].index == two.keyframes[before - 1].index  # it begins where the first part ended
    assert two.clouds.loan(before) is not None  # and it borrows that keyframe's cloud
    assert "registration: geometric" in one.sessions[0].config
    assert two.keyframes[-1].index >= 50
    # As good as one run: the ends of both are within 5 cm, and so is each keyframe that both have.
    a, b = aligned(one), aligned(two)
    common = sorted(a.keys() & b.keys())
    assert len(common) > before - 1
    assert max(np.linalg.norm(a[i][:3, 3] - b[i][:3, 3]) for i in common) < 0.05
    # The trajectory of the second run contains only the new frames; the map contains all.
    assert len(read_trajectory(tmp_path / "b" / "trajectory.tum")) == 60 - two.keyframes[before].index
    ended = dpm2("run", recording, "--out", tmp_path / "b", "--map", parts, "--resume", "--frames", "0:20", *RUN)
    assert f"--frames 0:20: the map goes on to frame {loaded(parts).keyframes[-1].index} already" in ended.stderr


@pytest.mark.slow
def test_a_drive_that_is_killed_leaves_a_sound_map(tmp_path: Path, recording: Path) -> None:
    """kill -9 of a real drive, after the network has tried loops that were rejected."""
    path = tmp_path / "a.dpm2map"
    rejecting = ("--set", "slam.loops.gap=3", "--set", "slam.loops.min_overlap=1", "--set", "slam.loops.radius=0")
    run = ("run", recording, "--out", tmp_path / "out", "--map", path, *rejecting)
    with started(*run, until=lambda: _rejected(path)):
        pass  # and kill -9
    done = succeeded("map", "check", path)
    assert "keyframes, no damage" in done.stdout
    assert _rejected(path)


def _rejected(path: Path) -> int:
    """Number of loops so far that the network has tried and that were rejected."""
    try:
        with MapStore.open(path) as store:
            return sum(ok == 0 for (ok,) in store.rows("edges", "ok"))
    except Dpm2Error:  # it does not exist yet, or is being made
        return 0


@pytest.mark.slow
def test_a_map_of_another_drive_is_not_gone_on_with(tmp_path: Path, recording: Path, map_file: Path) -> None:
    error = refused("run", recording, "--out", tmp_path / "a", "--map", map_file, "--resume", *RUN)
    assert "is not in" in error


def test_reading_commands_leave_the_file_as_it_is(tmp_path: Path, map_file: Path) -> None:
    before = hashlib.sha256(map_file.read_bytes()).digest()
    dpm2("map", "info", map_file)
    dpm2("map", "check", map_file)
    dpm2("map", "prune", map_file, "--out", tmp_path / "less.dpm2map")
    dpm2("map", "export", map_file, tmp_path / "a.ply")
    assert hashlib.sha256(map_file.read_bytes()).digest() == before
