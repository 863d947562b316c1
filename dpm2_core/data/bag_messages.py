# SPDX-License-Identifier: Apache-2.0
"""Builds ROS messages for rosbags from a frame's data: the inverse of `messages`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from dpm2_core.data import naming
from dpm2_core.data.messages import cloud_fields, point_columns
from dpm2_core.frame import Array, Camera, Fix, Frame
from dpm2_core.geometry import se3

_TYPES = get_typestore(Stores.ROS2_JAZZY).types


def header(stamp: int, frame: str) -> Any:
    """std_msgs/Header with a stamp, ns."""
    time = _TYPES["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return _TYPES["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _translation_and_quaternion(T: Array) -> tuple[list[float], list[float]]:
    return T[:3, 3].tolist(), se3.quaternion(T).tolist()


def _transform(stamp: int, parent: str, child: str, T: Array) -> Any:
    t, q = _translation_and_quaternion(T)
    transform = _TYPES["geometry_msgs/msg/Transform"](
        translation=_TYPES["geometry_msgs/msg/Vector3"](*t), rotation=_TYPES["geometry_msgs/msg/Quaternion"](*q)
    )
    return _TYPES["geometry_msgs/msg/TransformStamped"](
        header=header(stamp, parent), child_frame_id=child, transform=transform
    )


def _pose(T: Array) -> Any:
    t, q = _translation_and_quaternion(T)
    return _TYPES["geometry_msgs/msg/Pose"](
        position=_TYPES["geometry_msgs/msg/Point"](*t), orientation=_TYPES["geometry_msgs/msg/Quaternion"](*q)
    )


def _pose_stamped(stamp: int, T: Array) -> Any:
    return _TYPES["geometry_msgs/msg/PoseStamped"](header=header(stamp, naming.MAP), pose=_pose(T))


def odometry(stamp: int, child: str, T: Array) -> Any:
    """nav_msgs/Odometry of T_map_lidar (4, 4), with unknown velocity and uncertainty."""
    zero = _TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = _TYPES["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    return _TYPES["nav_msgs/msg/Odometry"](
        header=header(stamp, naming.MAP),
        child_frame_id=child,
        pose=_TYPES["geometry_msgs/msg/PoseWithCovariance"](pose=_pose(T), covariance=np.zeros(36)),
        twist=_TYPES["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def imu(stamp: int, rates: Array, forces: Array) -> Any:
    """sensor_msgs/Imu of (3,) rad/s and (3,) m/s2."""
    vector, unknown = _TYPES["geometry_msgs/msg/Vector3"], np.zeros(9)  # covariances
    no_orientation = np.array([-1.0, *np.zeros(8)])  # as defined by REP-145
    return _TYPES["sensor_msgs/msg/Imu"](
        header=header(stamp, naming.IMU_LINK), orientation=_TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        orientation_covariance=no_orientation, angular_velocity=vector(*rates.tolist()),
        angular_velocity_covariance=unknown, linear_acceleration=vector(*forces.tolist()),
        linear_acceleration_covariance=unknown,
    )  # fmt: skip


def nav_sat_fix(stamp: int, fix: Fix) -> Any:
    """sensor_msgs/NavSatFix of an antenna in the frame GNSS_LINK."""
    latitude, longitude, altitude = fix.geodetic.tolist()
    return _TYPES["sensor_msgs/msg/NavSatFix"](
        header=header(stamp, naming.GNSS_LINK), status=_TYPES["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=latitude, longitude=longitude, altitude=altitude, position_covariance=fix.covariance.ravel(),
        position_covariance_type=2,  # DIAGONAL_KNOWN
    )  # fmt: skip


def image(stamp: int, frame: str, pixels: NDArray[np.uint8]) -> Any:
    """sensor_msgs/Image of (H, W, 3) RGB pixels."""
    height, width = pixels.shape[:2]
    return _TYPES["sensor_msgs/msg/Image"](
        header=header(stamp, frame), height=height, width=width, encoding="rgb8", is_bigendian=0,
        step=3 * width, data=np.ascontiguousarray(pixels).reshape(-1),
    )  # fmt: skip


def camera_info(stamp: int, frame: str, camera: Camera) -> Any:
    """sensor_msgs/CameraInfo of the pixels as they are, without rectification: P is K."""
    D = np.zeros(max(5, len(camera.distortion)))
    D[: len(camera.distortion)] = camera.distortion
    model = "plumb_bob" if len(D) == 5 else "rational_polynomial"
    roi = _TYPES["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _TYPES["sensor_msgs/msg/CameraInfo"](
        header=header(stamp, frame), height=camera.size[1], width=camera.size[0], distortion_model=model, d=D,
        k=camera.K.reshape(-1), r=np.eye(3).reshape(-1), p=np.c_[camera.K, np.zeros(3)].reshape(-1),
        binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def cloud(stamp: int, lidar: str, frame: Frame) -> Any:
    """sensor_msgs/PointCloud2 in the frame `lidar`; with the field `time`, s after the stamp, if points have times."""
    columns = point_columns(frame.points)
    if frame.time_offset is not None:
        columns["time"] = frame.time_offset
    fields = cloud_fields(columns, _TYPES["sensor_msgs/msg/PointField"])
    return _TYPES["sensor_msgs/msg/PointCloud2"](header=header(stamp, lidar), **fields)


def path(stamp: int, poses: list[tuple[int, Array]]) -> Any:
    """nav_msgs/Path of stamps, ns, and T_map_lidar (4, 4)."""
    stamped = [_pose_stamped(at, T) for at, T in poses]
    return _TYPES["nav_msgs/msg/Path"](header=header(stamp, naming.MAP), poses=stamped)


def number(value: float) -> Any:
    """std_msgs/Float64."""
    return _TYPES["std_msgs/msg/Float64"](data=value)


def transforms(stamp: int, links: dict[str, tuple[str, Array]]) -> Any:
    """tf2_msgs/TFMessage of each child's parent and T_parent_child (4, 4)."""
    rows = [_transform(stamp, parent, child, T) for child, (parent, T) in links.items()]
    return _TYPES["tf2_msgs/msg/TFMessage"](transforms=rows)
