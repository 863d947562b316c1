# SPDX-License-Identifier: Apache-2.0
"""Messages carry the core's data: points exactly, poses to rounding, covariances in the convention of ROS."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dpm2_core.data.messages import decode_points, stamp_ns
from dpm2_core.data.thumbnail import image_of, thumbnail
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Keyframe, Registration
from dpm2_core.frame import Array, Fix
from dpm2_core.geometry import se3
from dpm2_core.slam.registration.texture import Texture, textured
from dpm2_ros import conversions
from dpm2_ros.stamps import stamp_to_msg
from test.helpers.corridor import frame, random_paint

tangents = hnp.arrays(np.float64, 6, elements=st.floats(-1.5, 1.5))
EXACT = 1e-9  # double precision through a quaternion, at 100 m


def spd(seed: int) -> Array:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    return A @ A.T


def motion(T: Array) -> conversions.BodyMotion:
    return conversions.BodyMotion(5, T, spd(2), np.arange(6.0))


@given(hnp.arrays(np.float32, st.tuples(st.integers(0, 50), st.just(4)), elements=st.floats(0, 1, width=32)))
def test_points_survive_to_the_bit(points: np.ndarray) -> None:
    message = conversions.cloud_to_msg(points, 1_700_000_000_123_456_789, "lidar")
    back, times = decode_points(message)
    np.testing.assert_array_equal(back, points)
    assert times is None
    assert (stamp_ns(message.header), message.header.frame_id) == (1_700_000_000_123_456_789, "lidar")


def test_nan_points_survive() -> None:
    points = np.array([[np.nan, 1, 2, 0.5], [3, 4, 5, 0.25]], np.float32)
    np.testing.assert_array_equal(decode_points(conversions.cloud_to_msg(points, 0, ""))[0], points)


def test_a_large_cloud_is_converted_without_a_loop_over_its_bytes() -> None:
    """120,000 points take 1 ms; the obvious implementation with rclpy takes over 60 ms."""
    points = np.zeros((120_000, 4), np.float32)
    best = np.inf
    for _ in range(5):
        begin = time.perf_counter()
        conversions.cloud_to_msg(points, 0, "lidar")
        best = min(best, time.perf_counter() - begin)
    assert best < 0.02


@given(tangents)
def test_poses_and_transforms_survive(xi: np.ndarray) -> None:
    T = se3.exp(xi)
    np.testing.assert_allclose(transform_matrix(conversions.pose_to_msg(T)), T, atol=EXACT)
    stamped = conversions.transform_to_msg(T, 7, "map", "odom")
    np.testing.assert_allclose(transform_matrix(stamped.transform), T, atol=EXACT)
    assert (stamped.header.frame_id, stamped.child_frame_id) == ("map", "odom")


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_stamps_survive(stamp: int) -> None:
    message = stamp_to_msg(stamp)
    assert message.sec * 10**9 + message.nanosec == stamp


@given(tangents, st.integers(0, 100))
def test_covariance_round_trip(xi: np.ndarray, seed: int) -> None:
    R, covariance = se3.exp(xi)[:3, :3], spd(seed)
    ros = conversions.covariance_to_ros(covariance, R)
    np.testing.assert_allclose(conversions.covariance_from_ros(ros, R), covariance, atol=EXACT)


def test_covariance_is_translation_first_along_the_axes_of_the_header() -> None:
    """A body that is rotated left by 90 degrees and uncertain along its own x is uncertain along the header's y."""
    R = se3.exp([0, 0, np.pi / 2, 0, 0, 0])[:3, :3]
    covariance = np.diag([1e-4, 2e-4, 3e-4, 4.0, 1.0, 0.25])
    ros = conversions.covariance_to_ros(covariance, R).reshape(6, 6)
    np.testing.assert_allclose(np.diag(ros), [1.0, 4.0, 0.25, 2e-4, 1e-4, 3e-4], atol=EXACT)


@given(tangents, st.integers(0, 20))
def test_covariance_describes_the_same_errors(xi: np.ndarray, seed: int) -> None:
    """Errors drawn in the core's convention, expressed in the header's axes, have the covariance of the message."""
    T, covariance = se3.exp(xi), spd(seed) * 1e-8
    errors = np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance, 4000)
    perturbed = T @ se3.exp(errors)
    translation = perturbed[:, :3, 3] - T[:3, 3]
    rotation = se3.log(perturbed @ se3.inverse(T))[:, :3]  # about fixed axes: on the left
    measured = np.cov(np.hstack([translation, rotation]).T)
    info = conversions.covariance_to_ros(covariance, T[:3, :3]).reshape(6, 6)
    np.testing.assert_allclose(measured, info, atol=0.15 * np.abs(info).max())  # 4000 samples: 5 %


def test_odometry_message() -> None:
    T = se3.exp([0.1, 0.2, 0.3, 1, 2, 3])
    message = conversions.odometry_to_msg(motion(T), spd(3), 0.1, "odom", "base")
    assert (message.header.frame_id, message.child_frame_id, stamp_ns(message.header)) == ("odom", "base", 5)
    np.testing.assert_allclose(conversions.covariance_from_ros(message.pose.covariance, T[:3, :3]), spd(3), atol=EXACT)
    twist = message.twist.twist
    assert (twist.angular.x, twist.angular.y, twist.angular.z) == (0, 1, 2)
    assert (twist.linear.x, twist.linear.y, twist.linear.z) == (3, 4, 5)
    # a step of 0.1 s: the covariance of the twist is a hundred times that of the step
    twist_covariance = conversions.covariance_from_ros(message.twist.covariance, np.eye(3))
    np.testing.assert_allclose(twist_covariance, 100 * spd(2), rtol=1e-9)


@pytest.mark.parametrize(("robot", "id", "name"), [("", 0, "kf_0"), ("r1", 12, "r1/kf_12"), ("a/b", 3, "a/b/kf_3")])
def test_keyframe_names(robot: str, id: int, name: str) -> None:
    assert conversions.keyframe_name(robot, id) == name
    assert conversions.parse_keyframe_name(name) == (robot, id, "")
    session = conversions.keyframe_name(robot, id, "5f3a9c01")
    assert conversions.parse_keyframe_name(session) == (robot, id, "5f3a9c01")


@pytest.mark.parametrize("name", ["", "odom", "kf_", "kf_-1", "kf_x", "robot/12", "kf_1/odom"])
def test_other_frames_are_no_keyframes(name: str) -> None:
    with pytest.raises(UsageError, match="is no keyframe"):
        conversions.parse_keyframe_name(name)


def test_a_picture_shows_the_points_where_it_did_also_seen_from_the_base() -> None:
    """If a keyframe is transformed to the base, points project to the same pixels, since the camera's pose is
    transformed, too. Place recognition in tunnels uses this."""
    T_base_lidar = se3.exp([np.pi, 0, 0, -0.6, 0.1, 1.7])  # a LiDAR that is mounted upside down
    seen = frame(0.0, random_paint())
    keyframe = Keyframe(0, 0, 0, np.eye(4), seen.points, thumbnail=thumbnail(seen.images[0], 320))

    def pixels(of: Keyframe) -> tuple[Array, Texture]:
        image = image_of(of.thumbnail or b"")
        assert image is not None
        texture = textured(image)
        uv, shown = texture.project(se3.transform(texture.T_cam_lidar, of.cloud[:, :3].astype(np.float64)))
        return uv[shown], texture

    from_lidar, before = pixels(keyframe)
    from_base, after = pixels(conversions.keyframe_to_base(keyframe, T_base_lidar, T_base_lidar))
    assert len(from_lidar) > 1000
    np.testing.assert_allclose(from_base, from_lidar, atol=1e-2)  # the cloud is float32
    np.testing.assert_array_equal(after.levels[0], before.levels[0])  # the JPEG itself is not encoded again


@given(tangents, tangents, tangents)
def test_motion_of_the_base(xi: np.ndarray, mount: np.ndarray, first: np.ndarray) -> None:
    """The base starts at the origin, wherever the LiDAR starts in its odometry; a world point stays at its position;
    and steps of base and LiDAR describe the same motion."""
    T_base_lidar, T_odom_first, T_first_lidar = se3.exp(mount), se3.exp(first), se3.exp(xi)
    T_start_odom, T_odom_lidar = T_base_lidar @ se3.inverse(T_odom_first), T_odom_first @ T_first_lidar
    cloud = np.array([[1, 2, 3, 0.5]], np.float32)
    edge = Registration(T_first_lidar, spd(4), 1.0, 0.0, "geometric")
    fix = Fix(5, np.array([49.0, 8.4, 110.0]), np.eye(3), np.array([1.0, 2.0, 3.0]))  # antenna: that point
    keyframe = Keyframe(1, 5, 0, T_odom_lidar, cloud, edge, fix=fix)
    base = motion(T_odom_lidar).of_base(T_base_lidar, T_start_odom)
    start = motion(T_odom_first).of_base(T_base_lidar, T_start_odom)
    np.testing.assert_allclose(start.T_odom_body, np.eye(4), atol=EXACT)
    np.testing.assert_allclose(base.T_odom_body @ T_base_lidar, T_base_lidar @ T_first_lidar, atol=EXACT)
    seen = conversions.keyframe_to_base(keyframe, T_base_lidar, T_start_odom)
    assert seen.edge is not None
    assert seen.fix is not None
    np.testing.assert_allclose(seen.fix.antenna, seen.cloud[0, :3], atol=1e-5)
    np.testing.assert_allclose(seen.origin, T_base_lidar[:3, 3], atol=EXACT)
    in_odom = seen.T_odom_kf @ np.append(seen.cloud[0, :3].astype(float), 1)
    expected = T_base_lidar @ T_first_lidar @ np.append(cloud[0, :3].astype(float), 1)
    np.testing.assert_allclose(in_odom, expected, atol=1e-5)  # the cloud is float32
    np.testing.assert_allclose(seen.edge.T_target_source, seen.T_odom_kf, atol=EXACT)
    # exp(twist dt) of the base is that of the LiDAR, conjugated by the mounting
    step = T_base_lidar @ se3.exp(0.1 * motion(T_odom_lidar).twist) @ se3.inverse(T_base_lidar)
    np.testing.assert_allclose(se3.exp(0.1 * base.twist), step, atol=1e-8)
