# SPDX-License-Identifier: Apache-2.0
"""A bag with fixes through `dpm2 run` into a map file, and from there onto other people's maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import convert_kitti
from dpm2_core.data.kitti import KittiSource
from dpm2_core.frame import Array
from dpm2_core.geometry import geodesy, se3
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

from ...helpers.command import dpm2

T_ECEF_WORLD = geodesy.enu_frame([49.0, 8.4, 110.0]) @ se3.exp(np.array([0, 0, 0.6, 0, 0, 0]))
ANTENNA = np.array([0.4, 0.0, 0.3])
SIGMA = 0.05


def with_fixes(bag: Path, out: Path) -> Array:
    """The bag, and between its scans where an antenna was by the ground truth; returns its geodetic places (N, 3)."""
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, rng = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(0)
    source = BagSource(bag)
    poses, stamps = source.poses, source.stamps
    assert poses is not None
    middle = poses[:-1] @ se3.exp(0.3 * se3.log(se3.inverse(poses[:-1]) @ poses[1:]))
    places = geodesy.geodetic((T_ECEF_WORLD @ middle @ np.append(ANTENNA, 1))[:, :3])
    noisy = (T_ECEF_WORLD @ middle @ np.append(ANTENNA, 1))[:, :3] + rng.normal(size=(len(places), 3)) * SIGMA
    times = stamps[:-1] + np.round(0.3 * np.diff(stamps)).astype(np.int64)
    with Reader(bag) as reader, Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kinds: dict[str, Any] = {}
        for connection, time, data in reader.messages():
            if connection.topic not in kinds:
                kinds[connection.topic] = writer.add_connection(connection.topic, connection.msgtype, typestore=store)
            writer.write(kinds[connection.topic], time, data)
        of_fixes = writer.add_connection("/fix", "sensor_msgs/msg/NavSatFix", typestore=store)
        of_place = kinds["/tf_static"]
        writer.write(of_place, int(times[0]), store.serialize_cdr(_place(store), "tf2_msgs/msg/TFMessage"))
        for time, place in zip(times.tolist(), geodesy.geodetic(noisy), strict=True):
            message = _nav(store, time, place)
            writer.write(of_fixes, time, store.serialize_cdr(message, "sensor_msgs/msg/NavSatFix"))
    return places


def _header(store: Any, stamp: int, frame: str) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _place(store: Any) -> Any:
    transform = store.types["geometry_msgs/msg/Transform"](
        translation=store.types["geometry_msgs/msg/Vector3"](*ANTENNA.tolist()),
        rotation=store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    stamped = store.types["geometry_msgs/msg/TransformStamped"](
        header=_header(store, 0, "velo_link"), child_frame_id="gnss", transform=transform
    )
    return store.types["tf2_msgs/msg/TFMessage"](transforms=[stamped])


def _nav(store: Any, stamp: int, place: Array) -> Any:
    return store.types["sensor_msgs/msg/NavSatFix"](
        header=_header(store, stamp, "gnss"),
        status=store.types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=float(place[0]),
        longitude=float(place[1]),
        altitude=float(place[2]),
        position_covariance=(SIGMA**2 * np.eye(3)).ravel(),
        position_covariance_type=2,
    )


@pytest.mark.slow
def test_a_bag_with_fixes_makes_a_map_that_knows_its_place(recording: Path, tmp_path: Path) -> None:
    convert_kitti(KittiSource(recording / "sequences" / "00"), tmp_path / "plain")
    places = with_fixes(tmp_path / "plain", tmp_path / "bag")
    run = ("--set", "slam.registration=geometric", "--set", "slam.loops.descriptors=false")
    path, line = tmp_path / "a.dpm2map", tmp_path / "a.geojson"
    fixes = ("--set", "input.gnss_topic=/fix", "--set", "slam.keyframes.distance=2.5")
    done = dpm2("run", tmp_path / "bag", "--out", tmp_path / "out", "--map", path, *run, *fixes)
    assert done.returncode == 0, done.stderr
    with MapStore.open(path) as store:
        data = load_map(store)
    assert sum(keyframe.fix is not None for keyframe in data.keyframes) >= len(data) - 1
    assert data.georeference is not None
    assert dpm2("map", "export", path, line).returncode == 0
    (feature,) = json.loads(line.read_text())["features"]
    assert feature["properties"] == {"robot": "", "session": 1}
    drawn = np.array(feature["geometry"]["coordinates"])[:, [1, 0, 2]]
    way, true = geodesy.ecef(drawn), geodesy.ecef(places)
    gaps = np.linalg.norm(way[:, None] - true, axis=-1).min(1)
    assert gaps.max() < np.linalg.norm(ANTENNA) + 0.6  # to the nearest fix; the LiDAR is under the antenna
    figures = dpm2("map", "info", path, "--json", tmp_path / "info.json")
    assert figures.returncode == 0, figures.stderr
    known = json.loads((tmp_path / "info.json").read_text())["georeference"]
    assert known["fixes_used"] == known["fixes"] >= 9
    poses = BagSource(tmp_path / "bag").poses
    assert poses is not None
    world = np.degrees(0.6 + np.arctan2(poses[0, 1, 0], poses[0, 0, 0]))
    assert abs(known["heading_deg"] - world) < 4 * known["heading_sigma_deg"] + 0.2
    assert 0 < known["heading_sigma_deg"] < 0.5
    assert max(known["position_sigma_m"]) < 0.1
    assert "fixes used" in " ".join(figures.stdout.split())


def test_a_map_without_one_says_so(map_file: Path, tmp_path: Path) -> None:
    done = dpm2("map", "export", map_file, tmp_path / "a.geojson")
    assert done.returncode == 2
    assert done.stderr.strip().endswith("the map has no georeference; see input.gnss_topic")
    assert not (tmp_path / "a.geojson").exists()
    assert "georeference" in dpm2("map", "info", map_file).stdout
