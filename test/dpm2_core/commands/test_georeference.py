# SPDX-License-Identifier: Apache-2.0
"""A simulated drive with fixes through `dpm2 convert` and `dpm2 run` into a map, and onto other people's maps: near the
truth, also where a receiver errs for a while."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dpm2_core.data.convert import EPOCH_NS
from dpm2_core.data.kitti import KittiSource
from dpm2_core.frame import Array
from dpm2_core.geometry import geodesy
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, GnssConfig, LidarConfig
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

from ...helpers.command import dpm2
from ...helpers.drives import first_scans

FRAMES, SIGMA = 40, 0.05
WRONG = slice(14, 24)  # of the fixes, a quarter
GNSS = GnssConfig(rate=10, noise=SIGMA, wander=0)
OPTIONS = ("slam.registration=geometric", "slam.loops.descriptors=false", "slam.keyframes.distance=1.5")


class Result(NamedTuple):
    """Of a run.

    Attributes:
        off: (K, 3) of the exported way from the truth, to the east, north and up, m. info: of `dpm2 map info`.
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
    """Stamps, ns, and where the LiDAR was on Earth (N, 3)."""
    source = KittiSource(drive)
    assert source.poses is not None
    assert source.T_cam_lidar is not None
    first = np.load(source.path / "ground.npz")["T_grid_cam0"]  # the grid's frame is the world's
    places = geodesy.enu_frame(GNSS.origin) @ first @ source.T_cam_lidar @ source.poses
    return source.stamps.tolist(), geodesy.geodetic(places[:, :3, 3])


def run(recording: Path, drive: Path, out: Path, *settings: str, epoch: int = 0) -> Result:
    path, line = out / "a.dpm2map", out / "a.geojson"
    words = [word for setting in (*OPTIONS, *settings) for word in ("--set", setting)]
    done = dpm2("run", recording, "--out", out / "run", "--map", path, *words)
    assert done.returncode == 0, done.stderr
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
    assert dpm2("convert", "kitti", drive / "sequences" / "00", tmp_path / "bag").returncode == 0
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
def test_fixes_that_are_50_m_off_for_a_while_bend_nothing(drive: Path, tmp_path: Path) -> None:
    """As between high houses; of a folder, without a bag."""
    copy = first_scans(drive, FRAMES, tmp_path / "copy")
    path = copy / "sequences" / "00" / "gnss.txt"
    rows = np.loadtxt(path)
    rows[WRONG, 1:3] += np.array([30.0, 40.0]) / [111_200, 111_200 * np.cos(np.radians(49.0))]  # m a degree
    path.unlink()
    np.savetxt(path, rows, "%.12e")
    found = run(copy, drive, tmp_path)
    assert np.abs(found.off).max() < 3 * SIGMA
    wrong = found.info["fixes"] - found.info["fixes_used"]
    assert wrong >= 5  # of those that came with a keyframe


def test_a_map_without_one_says_so(map_file: Path, tmp_path: Path) -> None:
    done = dpm2("map", "export", map_file, tmp_path / "a.geojson")
    assert done.returncode == 2
    assert done.stderr.strip().endswith("the map has no georeference; see input.gnss_topic")
    assert not (tmp_path / "a.geojson").exists()
    assert "georeference" in dpm2("map", "info", map_file).stdout
