# SPDX-License-Identifier: Apache-2.0
"""A simulated drive with fixes through `dpm2 convert` and `dpm2 run` into a map, and onto external maps: close to the
truth, also if the receiver has large errors for a while."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dpm2_core.data.convert import EPOCH_NS
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.estimates import Edge, Registration
from dpm2_core.frame import Array, Fix, Georeference
from dpm2_core.geometry import geodesy, se3
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, GnssConfig, LidarConfig
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.mapping.merge import merge_maps
from dpm2_core.slam.mapping.occupancy import ground_tilt
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import MapData, load_map, save_as
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.store.rows import RemovedKeyframe

from ...helpers.command import dpm2, refused, succeeded
from ...helpers.drives import first_scans
from ...helpers.maps import ring

FRAMES, SIGMA = 40, 0.05
ORIGIN = np.array([49.0, 8.4, 110.0])
WRONG = slice(14, 24)  # of the fixes: a quarter
GNSS = GnssConfig(rate=10, noise=SIGMA, wander=0)
OPTIONS = ("slam.registration=geometric", "slam.loops.descriptors=false", "slam.keyframes.distance=1.5")


class Result(NamedTuple):
    """The result of a run.

    Attributes:
        off: (K, 3) deviation of the exported trajectory from the truth, to the east, north and up, m. info: of `dpm2
        map info`.
    """

    off: Array
    info: dict[str, Any]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fixes") / "drive"
    lidar = LidarConfig(beams=32, columns=600)
    simulate(root, DriveConfig(frames=FRAMES, seed=2, road="straight", preset="suburb", images=False, lidar=lidar,
                               gnss=GNSS))  # fmt: skip
    return root


def truth(drive: Path) -> tuple[list[int], Array]:
    """Stamps, ns, and the geodetic positions of the LiDAR (N, 3)."""
    source = KittiSource(drive)
    assert source.poses is not None
    assert source.T_cam_lidar is not None
    first = np.load(source.path / "ground.npz")["T_grid_cam0"]  # the grid's frame is the world's
    places = geodesy.enu_frame(ORIGIN) @ first @ source.T_cam_lidar @ source.poses
    return source.stamps.tolist(), geodesy.geodetic(places[:, :3, 3])


def run(recording: Path, drive: Path, out: Path, *settings: str, epoch: int = 0) -> Result:
    path, line = out / "a.dpm2map", out / "a.geojson"
    words = [word for setting in (*OPTIONS, *settings) for word in ("--set", setting)]
    succeeded("run", recording, "--out", out / "run", "--map", path, *words)
    assert dpm2("map", "export", path, line).returncode == 0
    assert dpm2("map", "info", path, "--json", out / "info.json").returncode == 0
    (feature,) = json.loads(line.read_text())["features"]
    assert feature["properties"] == {"robot": "", "session": 1}
    way = np.array(feature["geometry"]["coordinates"])[:, [1, 0, 2]]
    with MapStore.open(path) as store:
        stamps = [keyframe.stamp - epoch for keyframe in load_map(store).keyframes]
    known, places = truth(drive)
    true = places[[known.index(stamp) for stamp in stamps]]
    T_ecef_enu = geodesy.enu_frame(true[0])
    off = (geodesy.ecef(way) - geodesy.ecef(true)) @ T_ecef_enu[:3, :3]
    return Result(off, json.loads((out / "info.json").read_text())["georeference"])


@pytest.mark.slow
def test_a_bag_with_fixes_makes_a_map_that_knows_its_place(drive: Path, tmp_path: Path) -> None:
    assert dpm2("convert", drive / "sequences" / "00", tmp_path / "bag").returncode == 0
    found = run(tmp_path / "bag", drive, tmp_path, "input.gnss_topic=/fix", epoch=EPOCH_NS)
    assert len(found.off) >= 20
    assert np.abs(found.off).max() < 3 * SIGMA
    info = found.info
    assert info["fixes_used"] == info["fixes"] >= len(found.off) - 1
    source = KittiSource(drive)
    start = np.load(source.path / "ground.npz")["T_grid_cam0"] @ source.T_cam_lidar
    heading = np.degrees(np.arctan2(start[1, 0], start[0, 0]))
    assert abs(info["heading_deg"] - heading) < 4 * info["heading_sigma_deg"]
    assert 0 < info["heading_sigma_deg"] < 0.5
    assert max(info["position_sigma_m"]) < 2 * SIGMA  # in height the fixes err by twice as much
    shown = " ".join(dpm2("map", "info", tmp_path / "a.dpm2map").stdout.split())
    assert f"{info['fixes']} of {info['fixes']} fixes used" in shown


@pytest.mark.slow
def test_a_lidar_that_hangs_has_a_level_map_with_its_place_on_earth(drive: Path) -> None:
    """Its mounting must be known; in an upside-down map, the fixes of a trajectory with bends do not match."""
    T_hanging = np.diag([1.0, -1.0, -1.0, 1.0])
    settings = {"registration": "geometric", "loops": {"descriptors": False}, "keyframes": {"distance": 1.5}}
    slam = make_slam(SlamSettings.model_validate(settings))
    for frame in KittiSource(drive).frames():
        fix = None if frame.fix is None else frame.fix.moved(T_hanging)
        points = se3.transform(T_hanging, frame.points)
        slam.process(replace(frame, points=points, fix=fix, images=(), up=(0.0, 0.0, -1.0)))
    slam.finish()
    assert ground_tilt(slam.mapper.clouds, slam.mapper.poses) < 5
    assert slam.mapper.graph.georeference.T_enu_map[2, 2] > 0.99


@pytest.mark.slow
def test_fixes_that_are_50_m_off_for_a_while_bend_nothing(drive: Path, tmp_path: Path) -> None:
    """As between high houses; from a folder, without a bag."""
    copy = first_scans(drive, FRAMES, tmp_path / "copy")
    path = copy / "sequences" / "00" / "gnss.txt"
    rows = np.loadtxt(path)
    rows[WRONG, 1:3] += np.array([30.0, 40.0]) / [111_200, 111_200 * np.cos(np.radians(49.0))]  # m per degree
    path.unlink()
    np.savetxt(path, rows, "%.12e")
    found = run(copy, drive, tmp_path)
    assert np.abs(found.off).max() < 3 * SIGMA
    wrong = found.info["fixes"] - found.info["fixes_used"]
    assert wrong >= 5  # of those that are associated with a keyframe


FAR = np.array([300.0, 40.0, 5.0])  # m, from the first drive to the second


def two_drives(wrong_first: bool = False, tied: bool = False, fixes: bool = True) -> MapData:
    """A ring of 40 keyframes with a fix each, and another one that begins at the same pose in the map.

    Args:
        wrong_first: the first loop between the two is one that the optimization rejected.
        tied: the second is the first again, with 20 loops between them; otherwise it is at FAR. fixes: of the second
        one.
    """
    one = ring(40, points=10)
    two = merge_maps(one, one, np.eye(4))
    keyframes = []
    for node, (keyframe, T) in enumerate(zip(two.keyframes, two.poses, strict=True)):
        off = FAR if node >= 40 and not tied else np.zeros(3)
        place = geodesy.geodetic((geodesy.enu_frame(ORIGIN) @ np.append(T[:3, 3] + off, 1))[:3])
        fix = Fix(keyframe.stamp, place, np.eye(3) * 0.02**2, np.zeros(3))
        keyframes.append(replace(keyframe, fix=fix if fixes or node < 40 else None))
    loops = []
    if tied:
        T = se3.exp(np.array([0, 0, 0.3, 9.0, 0, 0])) if wrong_first else np.eye(4)
        loops = [Edge("loop", 5, 45, Registration(T, np.eye(6) * 1e-4))]
        loops += [Edge("loop", node, 40 + node, Registration(np.eye(4), np.eye(6) * 1e-4)) for node in range(6, 26)]
    return replace(two, keyframes=keyframes, edges=[*two.edges, *loops], georeference=Georeference(ORIGIN, np.eye(4)))


def lines_of(path: Path) -> dict[int, Array]:
    """(K, 3) east, north, up about ORIGIN, m, of each session of a GeoJSON file."""
    out = {}
    for feature in json.loads(path.read_text())["features"]:
        way = np.array(feature["geometry"]["coordinates"])[:, [1, 0, 2]]
        out[feature["properties"]["session"]] = se3.transform(se3.inverse(geodesy.enu_frame(ORIGIN)), geodesy.ecef(way))
    return out


def test_a_drive_that_nothing_ties_to_the_map_is_written_where_its_own_fixes_are(tmp_path: Path) -> None:
    data = two_drives()
    save_as(data, tmp_path / "map")
    assert dpm2("map", "export", tmp_path / "map", tmp_path / "a.geojson").returncode == 0
    lines = lines_of(tmp_path / "a.geojson")
    for session, off in ((1, np.zeros(3)), (2, FAR)):
        np.testing.assert_allclose(lines[session], data.poses[:40, :3, 3] + off, atol=0.01)  # the file has mm


def test_a_drive_that_nothing_places_is_left_out_and_named(tmp_path: Path) -> None:
    save_as(two_drives(fixes=False), tmp_path / "map")
    done = succeeded("map", "export", tmp_path / "map", tmp_path / "a.geojson")
    assert "40 of the 40 keyframes of session 2 are left out" in done.stderr
    assert set(lines_of(tmp_path / "a.geojson")) == {1}


def test_a_drive_of_which_all_is_pruned_is_written_and_where_nothing_places_it_named(tmp_path: Path) -> None:
    """A drive whose keyframes are all pruned is exported. Previously, only the remaining keyframes were searched for
    drives: GeoJSON silently omitted this one, the page had it."""
    data = two_drives(fixes=False)
    beside = se3.exp([0, 0, 0, 0, 2.0, 0])
    trail = [RemovedKeyframe(100 + node, "", 3, node * 10**9, node, beside) for node in range(20)]
    trail += [RemovedKeyframe(200 + node, "", 4, node * 10**9, node, beside) for node in range(40, 50)]
    sessions = [replace(data.sessions[0], number=number) for number in (1, 2, 3, 4)]
    save_as(replace(data, trail=trail, sessions=sessions), tmp_path / "map")
    done = dpm2("map", "export", tmp_path / "map", tmp_path / "a.geojson")
    lines = lines_of(tmp_path / "a.geojson")
    assert sorted(lines) == [1, 3]
    np.testing.assert_allclose(lines[3], (data.poses[:20] @ beside)[:, :3, 3], atol=0.01)  # the file has mm
    assert "10 of the 10 keyframes of session 4 are left out" in done.stderr
    done = dpm2("map", "export", tmp_path / "map", tmp_path / "a.tum")
    assert len(read_trajectory(tmp_path / "a.tum")) == 60
    assert "10 of the 10 keyframes of session 4 are left out" in done.stderr


def test_only_fixes_that_are_in_the_graph_count_as_used(tmp_path: Path) -> None:
    for name, data, used in (("apart", two_drives(), 40), ("tied", two_drives(wrong_first=True, tied=True), 80)):
        save_as(data, tmp_path / name)
        done = dpm2("map", "info", tmp_path / name, "--json", tmp_path / "info.json")
        assert f"{used} of 80 fixes used" in " ".join(done.stdout.split())
        assert json.loads((tmp_path / "info.json").read_text())["georeference"]["fixes_used"] == used


def test_info_says_what_is_not_tied_and_measures_the_rest(tmp_path: Path) -> None:
    """The two drives are far apart, each in a frame of its own."""
    save_as(two_drives(), tmp_path / "map")
    done = dpm2("map", "info", tmp_path / "map", "--json", tmp_path / "info.json")
    assert "40 of them not connected to the first keyframe" in " ".join(done.stdout.split())
    figures = json.loads((tmp_path / "info.json").read_text())
    assert [session["untied"] for session in figures["sessions"]] == [0, 40]
    np.testing.assert_allclose(figures["extent_m"], np.ptp(two_drives().poses[:40, :3, 3], axis=0))


def test_fixes_that_do_not_tell_it_are_counted(tmp_path: Path) -> None:
    data = replace(two_drives(tied=True), georeference=None)
    save_as(data, tmp_path / "map")
    assert "(80 fixes do not determine it" in " ".join(dpm2("map", "info", tmp_path / "map").stdout.split())
    assert "80 fixes do not determine it" in dpm2("map", "export", tmp_path / "map", tmp_path / "a.geojson").stderr


def test_fixes_of_a_drive_that_is_not_tied_to_the_first_place_that_drive_alone(tmp_path: Path) -> None:
    data = two_drives()
    first = [replace(keyframe, fix=None) for keyframe in data.keyframes[:40]]
    save_as(replace(data, keyframes=[*first, *data.keyframes[40:]], georeference=None), tmp_path / "map")
    shown = " ".join(dpm2("map", "info", tmp_path / "map").stdout.split())
    assert "georeference - (40 fixes are of keyframes that no loop connects to the first)" in shown
    done = dpm2("map", "export", tmp_path / "map", tmp_path / "a.geojson")
    assert "40 of the 40 keyframes of session 1 are left out: neither their own fixes" in done.stderr
    lines = lines_of(tmp_path / "a.geojson")
    assert set(lines) == {2}
    np.testing.assert_allclose(lines[2], data.poses[40:, :3, 3] + FAR, atol=0.01)  # the file has mm
    # Two fixes of the first drive, and five of the second within 20 m that are 5 m off: neither determine its pose.
    few = [replace(k, fix=k.fix if node in (0, 1, *range(40, 45)) else None) for node, k in enumerate(data.keyframes)]
    few = [replace(k, fix=k.fix and replace(k.fix, covariance=np.eye(3) * 25.0)) for k in few]
    save_as(replace(data, keyframes=few, georeference=None), tmp_path / "few")
    error = refused("map", "export", tmp_path / "few", tmp_path / "few.geojson")
    assert "2 fixes do not determine it: the trajectory is too short or too straight, or at least half" in error
    assert "; 5 fixes are of keyframes that" in error


def test_a_map_without_one_says_so(map_file: Path, tmp_path: Path) -> None:
    error = refused("map", "export", map_file, tmp_path / "a.geojson")
    assert error.strip().endswith("the map has no georeference: no GNSS fixes; see input.gnss_topic")
    assert not (tmp_path / "a.geojson").exists()
    assert "georeference" in dpm2("map", "info", map_file).stdout


def test_a_recovered_map_is_where_its_fixes_are(tmp_path: Path) -> None:
    """If the row with the georeference is damaged, it is computed again from the fixes. Previously, the recovered map
    had none, and "80 fixes do not tell it"."""
    data = two_drives()
    save_as(data, tmp_path / "map")
    with closing(sqlite3.connect(tmp_path / "map")) as sql, sql:
        sql.execute("UPDATE georeference SET latitude = 0")
    done = dpm2("map", "check", tmp_path / "map", "--recover", tmp_path / "again")
    assert "georeference 0: its checksum is wrong" in done.stdout
    assert dpm2("map", "export", tmp_path / "again", tmp_path / "a.geojson").returncode == 0
    np.testing.assert_allclose(lines_of(tmp_path / "a.geojson")[1], data.poses[:40, :3, 3], atol=0.01)
    assert "40 of 80 fixes used" in " ".join(dpm2("map", "info", tmp_path / "again").stdout.split())
