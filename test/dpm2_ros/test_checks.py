# SPDX-License-Identifier: Apache-2.0
"""Sensor messages with impossible content are rejected, and what is known already is kept."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from sensor_msgs.msg import PointField
from std_msgs.msg import Header

from dpm2_core.data.transforms import TransformTree
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_ros.checks import check_header, check_size, checked_cloud, extended, replaced
from dpm2_ros.conversions import cloud_to_msg
from dpm2_ros.guard import excerpt


def transform(parent: str, child: str, x: float = 1.0, w: float = 1.0) -> TransformStamped:
    moved = Transform(translation=Vector3(x=x), rotation=Quaternion(w=w))
    return TransformStamped(header=Header(frame_id=parent), child_frame_id=child, transform=moved)


def message(*transforms: TransformStamped) -> SimpleNamespace:
    return SimpleNamespace(transforms=list(transforms))  # tf2_msgs need not be installed


@pytest.mark.parametrize(
    "bad", [{"x": np.nan}, {"x": 1e30}, {"w": 0.0}, {"w": np.inf}, {"child": "c" * 300}, {"child": ""}]
)
def test_one_unsound_transform_does_not_cost_the_others(bad: dict[str, object]) -> None:
    tree, _ = extended(TransformTree(), message(transform("base", "lidar")))
    unsound = transform(**({"parent": "base", "child": "lidar"} | bad))
    after, problem = extended(tree, message(transform("base", "imu"), unsound, transform("base", "camera")))
    assert problem
    assert len(problem) < 500
    assert after.frames == ["base", "camera", "imu", "lidar"]
    np.testing.assert_array_equal(after.lookup("base", "lidar"), tree.lookup("base", "lidar"))


@pytest.mark.parametrize(
    ("later", "said"),
    [
        (transform("base", "lidar", x=1.0004), ""),  # the same one, rounded differently
        (transform("base", "lidar", x=1.3), "lidar has moved by 0.30 m and 0.0 deg in base"),
        (transform("mast", "lidar"), "lidar has the parent mast, no longer base"),
        (transform("base", "camera", x=1.3), ""),  # a new frame
    ],
    ids=["same", "moved", "another parent", "new"],
)
def test_what_two_publishers_say_otherwise_of_a_frame(later: TransformStamped, said: str) -> None:
    tree, _ = extended(TransformTree(), message(transform("base", "lidar")))
    after, _ = extended(tree, message(later))
    assert replaced(tree, after) == said


def test_the_number_of_frames_is_bounded() -> None:
    """More frames are rejected; frames that are known already can still be moved."""
    tree, _ = extended(TransformTree(), message(transform("base", "lidar")))
    for k in range(50):
        tree, _ = extended(tree, message(*(transform(f"p{k}", f"c{k}_{n}") for n in range(200))))
    assert len(tree.frames) < 5000
    tree, _ = extended(tree, message(transform("base", "lidar", x=2.0)))
    assert tree.lookup("base", "lidar")[0, 3] == 2.0
    with pytest.raises(RejectedError, match="10000 transforms"):
        extended(tree, message(*[transform("a", "b")] * 10_000))


@pytest.mark.parametrize(
    ("sec", "nanosec", "frame"), [(-1, 0, "a"), (0, 10**9, "a"), (0, 0, "a b"), (0, 0, "a" * 201), (0, 0, "a\n")]
)
def test_headers_that_cannot_be_true(sec: int, nanosec: int, frame: str) -> None:
    with pytest.raises(RejectedError):
        check_header(Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=frame))
    check_header(Header(stamp=Time(sec=1, nanosec=1)))


def test_layouts_that_cannot_be_read() -> None:
    good = cloud_to_msg(np.zeros((10, 4), np.float32), 1, "lidar")
    assert checked_cloud(good)[1] == ""
    for field, value in {"point_step": 2**32 - 1, "width": 11, "height": 2, "data": b"", "fields": []}.items():
        cloud = cloud_to_msg(np.zeros((10, 4), np.float32), 1, "lidar")
        setattr(cloud, field, value)
        assert checked_cloud(cloud)[1], field
    for field in ("width", "height"):
        cloud = cloud_to_msg(np.zeros((10, 4), np.float32), 1, "lidar")
        setattr(cloud, field, 2**32 - 1)
        with pytest.raises(RejectedError, match=r"429496729\d+ points"):
            checked_cloud(cloud)
    good.fields = [PointField(name=name, offset=0, datatype=7, count=2**32 - 1) for name in ("x", "y", "z")]
    assert checked_cloud(good)[1]
    good.fields = [PointField(name="x" * 100_000, offset=0, datatype=7, count=1)] * 100
    assert len(checked_cloud(good)[1]) < 400
    with pytest.raises(RejectedError, match="points"):
        check_size(good, 10**9)


def test_texts_of_others_are_one_line() -> None:
    assert excerpt("a\n\x1b[31mb\u202e") == r"a\n\x1b[31mb\u202e"
    assert len(excerpt("x" * 10**6)) < 400
