# SPDX-License-Identifier: Apache-2.0
"""Clouds as published by the drivers of eight LiDARs: each is decoded and deskewed.

Layouts (names, types, offsets, step, origin of the times) are those that the drivers' PointField lists declare.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dpm2_core.data.frames import Calibration, FrameBuilder
from dpm2_core.data.livox import cloud_of_custom
from dpm2_core.data.settings import InputSettings
from dpm2_core.geometry import se3
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings
from test.helpers.livox import custom_message

STAMP = 1_700_000_000_250_000_000
TWIST = np.array([0, 0, 1.0, 8.0, 0, 0])
"""A rotation of 57 deg/s at 8 m/s."""
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

LAYOUTS: dict[str, tuple[int, dict[str, tuple[str, int]], str, float, bool]] = {
    # step, fields with type and offset, the time field, its units per second, whether it counts from the epoch
    "Ouster (ouster-ros, PointXYZI + t)": (
        48, {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "intensity": ("f4", 16), "t": ("u4", 20),
             "reflectivity": ("u2", 24), "ring": ("u2", 26), "ambient": ("u2", 28), "range": ("u4", 32)},
        "t", 1e9, False),
    "Velodyne (velodyne_pointcloud)": (
        22, {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "intensity": ("f4", 12), "ring": ("u2", 16),
             "time": ("f4", 18)},
        "time", 1.0, False),
    "Hesai (HesaiLidar_ROS_2.0)": (
        26, {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "intensity": ("f4", 12), "ring": ("u2", 16),
             "timestamp": ("f8", 18)},
        "timestamp", 1.0, True),
    "Livox (livox_ros_driver2, xfer_format 0)": (
        26, {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "intensity": ("f4", 12), "tag": ("u1", 16),
             "line": ("u1", 17), "timestamp": ("f8", 18)},
        "timestamp", 1e9, True),
    "RoboSense (rslidar_sdk, XYZIRT)": (
        32, {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "intensity": ("f4", 16), "ring": ("u2", 20),
             "timestamp": ("f8", 24)},
        "timestamp", 1.0, True),
    "Aeva (time_offset_ns)": (
        28, {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "reflectivity": ("f4", 12), "velocity": ("f4", 16),
             "time_offset_ns": ("i4", 20), "line_index": ("u1", 24)},
        "time_offset_ns", 1e9, False),
    "Autoware's nebula (PointXYZIRCAEDT)": (
        32, {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "intensity": ("u1", 12), "return_type": ("u1", 13),
             "channel": ("u2", 14), "azimuth": ("f4", 16), "elevation": ("f4", 20), "distance": ("f4", 24),
             "time_stamp": ("u4", 28)},
        "time_stamp", 1e9, False),
}  # fmt: skip


def sweep() -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a wall at x = 20 m, each in the LiDAR frame at its time, and these times (N,), s after the
    stamp."""
    seconds = np.arange(2000) * 5e-5
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(2000, 20.0), rng.uniform(-15, 15, 2000), rng.uniform(-1, 5, 2000)])
    T = se3.inverse(se3.exp(seconds[:, None] * TWIST))
    return np.einsum("nij,nj->ni", T[:, :3, :3], wall) + T[:, :3, 3], seconds


def laid_out(name: str) -> Any:
    """The sweep as a PointCloud2 of this driver."""
    step, fields, time, units, absolute = LAYOUTS[name]
    points, seconds = sweep()
    dtype = np.dtype({"names": list(fields), "formats": [kind for kind, _ in fields.values()],
                      "offsets": [offset for _, offset in fields.values()], "itemsize": step})  # fmt: skip
    cloud = np.zeros(len(points), dtype)
    for i, axis in enumerate("xyz"):
        cloud[axis] = points[:, i]
    cloud[time] = (seconds + (STAMP * 1e-9 if absolute else 0)) * units
    stamp = SimpleNamespace(sec=STAMP // 10**9, nanosec=STAMP % 10**9)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="lidar"), height=1, width=len(cloud), is_bigendian=False,
        fields=[SimpleNamespace(name=n, offset=o, datatype=CODES[k], count=1) for n, (k, o) in fields.items()],
        point_step=step, row_step=step * len(cloud), data=cloud.tobytes(),
    )  # fmt: skip


def thickness(message: Any, settings: InputSettings | None = None) -> tuple[float, str]:
    """Thickness of the wall after de-skewing, m, and the problem that is reported for the times."""
    builder = FrameBuilder(settings or InputSettings(), Calibration("/points"), pytest.fail)
    frame = builder.frame(STAMP, message, 0)
    assert len(frame.points) == 2000
    points = Preprocessor(PreprocessSettings()).measured(frame, TWIST)[0]
    return float(np.abs(points[:, 0] - 20).max()), builder.time_problem


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_decode_and_are_deskewed(name: str) -> None:
    flat, problem = thickness(laid_out(name))
    assert flat < 0.02  # 64 poses along the sweep: 1 rad/s and 25 m leave 2 cm
    assert problem == ""
    smeared, _ = thickness(laid_out(name), InputSettings(time_field=""))
    assert smeared > 0.5


def test_livox_custom_messages_are_deskewed() -> None:
    points, seconds = sweep()
    flat, problem = thickness(cloud_of_custom(custom_message(STAMP, points, seconds)))
    assert flat < 0.02
    assert problem == ""


def test_a_cloud_without_times_says_so() -> None:
    message = laid_out("Velodyne (velodyne_pointcloud)")
    message.fields = message.fields[:5]
    smeared, problem = thickness(message)
    assert smeared > 0.5
    assert problem == "no time field: not de-skewed"
    assert thickness(message, InputSettings(time_field=""))[1] == ""  # as requested


def test_a_cloud_with_a_single_return_has_no_problem_of_its_times() -> None:
    """Such as a part of a sweep that shows the sky: the log reported that all points have the same time."""
    message = laid_out("Velodyne (velodyne_pointcloud)")
    for width, problem in ((1, ""), (2, "all points have the same time: not de-skewed")):
        message.width, message.row_step = width, width * message.point_step
        message.data = message.data[: message.point_step] * width
        builder = FrameBuilder(InputSettings(), Calibration("/points"), pytest.fail)
        assert len(builder.frame(STAMP, message, 0).points) == width
        assert builder.time_problem == problem
