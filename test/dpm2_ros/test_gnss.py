# SPDX-License-Identifier: Apache-2.0
"""slam_node with a GNSS receiver, over real DDS: late fixes georeference the map, hostile ones are counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import NavSatFix, NavSatStatus

from dpm2_core.frame import Array
from dpm2_core.geometry import geodesy, se3
from dpm2_ros.conversions import header
from test.helpers.rig import Rig, publish_static

from ..helpers.diagnostics import having

T_BASE_LIDAR = se3.exp([0.0, 0.0, 0.3, 0.8, 0.0, 1.2])
T_LIDAR_ANTENNA = se3.exp([0.0, 0.0, 0.0, -0.5, 0.2, 0.4])
T_ECEF_START = geodesy.enu_frame([49.0, 8.4, 110.0]) @ se3.exp([0, 0, 0.6, 0, 0, 0])
"""Of the LiDAR's first pose."""
SIGMA = 0.02


def nav(stamp: int, place: Array) -> NavSatFix:
    message = NavSatFix(header=header(stamp, "gnss"), position_covariance_type=NavSatFix.COVARIANCE_TYPE_KNOWN)
    message.latitude, message.longitude, message.altitude = place.tolist()
    message.position_covariance = (SIGMA**2 * np.eye(3)).ravel()
    return message


@pytest.mark.slow
def test_fixes_place_the_map_on_earth(rig: Callable[..., Rig], drive: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    r = rig("ros.base_frame:=base_link", "input.gnss_topic:=fix", "slam.keyframes.distance:=1.0")
    receiver = r.harness.publisher(NavSatFix, "/fix", reliable=False)
    publish_static(r, "base_link", "lidar", T_BASE_LIDAR)
    publish_static(r, "lidar", "gnss", T_LIDAR_ANTENNA)
    r.wait(receiver.get_subscription_count, "the subscription to the fixes")
    assert r.status("gnss", lambda s: s.message == "no fix on /fix yet").level == DiagnosticStatus.WARN
    rng = np.random.default_rng(0)
    for n in range(drive.frames):
        if n:  # fix of the previous scan, as from a receiver with a latency of 0.1 s
            ecef = T_ECEF_START @ drive.pose(n - 1) @ T_LIDAR_ANTENNA[:, 3]
            place = geodesy.geodetic(ecef[:3] + SIGMA * rng.normal(size=3))
            receiver.publish(nav(drive.stamp(n - 1), place))
            for wrong in ([np.nan, 8.4, 110.0], [91.0, 8.4, 110.0], [0.0, 0.0, 0.0]):
                receiver.publish(nav(drive.stamp(n - 1) + 1, np.array(wrong)))
        r.send_and_wait(n)
    mapper = r.node.slam.mapper
    r.wait(lambda: mapper.graph.georeference is not None, "the map's place on Earth")
    r.status("gnss", lambda s: s.message == "in use")
    lost = nav(drive.stamp(n), place)
    lost.status.status = NavSatStatus.STATUS_NO_FIX

    def is_said(status: DiagnosticStatus) -> bool:
        receiver.publish(lost)  # the messages continue: a receiver in a tunnel was reported as "in use"
        return status.message.startswith("no fix on /fix for")

    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 1.0)
    assert r.status("gnss", is_said).level == DiagnosticStatus.WARN
    monkeypatch.setattr("dpm2_ros.slam_diagnostics.SILENT", 10.0)
    receiver.publish(nav(drive.stamp(n) + 18 * 10**9, place))  # GPS has no leap seconds
    status = r.status("gnss", lambda s: s.message == "stamps of another clock, +18 s from the clouds'")
    assert status.level == DiagnosticStatus.WARN
    r.status("mapper", having(keyframes=drive.frames // 2, waiting=0))  # 0.8 m per scan: every second one
    r.wait(lambda: sum(r.node.rejections.values()) >= 3 * (drive.frames - 1), "the rejections")
    # map is the frame of the base's first pose, at height `base` above the ground
    known, T_start_map = mapper.graph.georeference, se3.inverse(T_BASE_LIDAR)
    found = geodesy.enu_frame(known.origin) @ known.T_enu_map
    way = se3.inverse(found) @ T_ECEF_START @ T_start_map
    assert np.linalg.norm(way[:3, 3]) < 0.2
    assert np.degrees(np.abs(se3.log(way)[2])) < 1.0
