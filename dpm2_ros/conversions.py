# SPDX-License-Identifier: Apache-2.0
"""Core types to ROS messages and back, without a Python loop over points or pixels.

Covariances: the core's is [rotation rad, translation m] of xi in T @ Exp(xi), that is, along the axes of the body;
ROS wants [translation, rotation about fixed axes] along the axes of the header's frame. Both describe the error at the
body's own position, so that a rotation of each block by R, and a swap, convert one to the other.
"""

from __future__ import annotations

import array
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped, Twist, Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from dpm2_core.data.messages import cloud_fields, point_columns
from dpm2_core.data.thumbnail import moved_thumbnail
from dpm2_core.estimates import Keyframe, OdometryResult
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_core.slam.store.rows import MAX_ID
from dpm2_ros.stamps import stamp_to_msg

_KEYFRAME_NAME = re.compile(
    r"(?:(?P<robot>[\w/]{1,200})/)?kf_(?P<id>[0-9]{1,10})(?:\.(?P<session>[0-9a-f]{8}-?))?", re.ASCII
)
EARLIER = "-"
_FRAME_NAME = re.compile(r"[^\s\x00-\x1f\x7f]{1,200}")
_SWAP = np.roll(np.eye(6), 3, axis=0)  # [rotation, translation] to [translation, rotation], and its own inverse


def header(stamp: int, frame_id: str) -> Header:
    """std_msgs/Header at a stamp in ns."""
    return Header(stamp=stamp_to_msg(stamp), frame_id=frame_id)


def vector(xyz: Array) -> Vector3:
    """(3,) to geometry_msgs/Vector3."""
    x, y, z = xyz.tolist()
    return Vector3(x=x, y=y, z=z)


def pose_to_msg(T: Array) -> Pose:
    """(4, 4) to geometry_msgs/Pose."""
    return poses_to_msgs(T[None])[0]


def poses_to_msgs(T: Array) -> list[Pose]:
    """(N, 4, 4) to geometry_msgs/Pose; many rotations at once take little longer than one."""
    quaternions, positions = se3.quaternion(T).tolist(), T[:, :3, 3].tolist()
    return [
        Pose(position=Point(x=tx, y=ty, z=tz), orientation=Quaternion(x=x, y=y, z=z, w=w))
        for (tx, ty, tz), (x, y, z, w) in zip(positions, quaternions, strict=True)
    ]


def transform_to_msg(T_parent_child: Array, stamp: int, parent: str, child: str) -> TransformStamped:
    """(4, 4) to geometry_msgs/TransformStamped."""
    translation, rotation = vector(T_parent_child[:3, 3]), pose_to_msg(T_parent_child).orientation
    return TransformStamped(
        header=header(stamp, parent),
        child_frame_id=child,
        transform=Transform(translation=translation, rotation=rotation),
    )


def covariance_to_ros(covariance: Array, R: Array) -> Array:
    """The core's (6, 6) to the 36 numbers of a PoseWithCovariance; R (3, 3) turns the body into the header's frame."""
    M = _SWAP @ np.kron(np.eye(2), R)
    return (M @ covariance @ M.T).ravel()


def covariance_from_ros(numbers: Array, R: Array) -> Array:
    """Inverse of `covariance_to_ros`."""
    M = np.kron(np.eye(2), R.T) @ _SWAP
    return M @ np.asarray(numbers, np.float64).reshape(6, 6) @ M.T


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Pose and motion of one frame of the vehicle: the LiDAR's, or one that is rigidly connected to it.

    Attributes:
        stamp: ns. T_odom_body: (4, 4).
        covariance: (6, 6) of the last step, as in `OdometryResult`. twist: (6,) [rad/s, m/s] in that frame.
    """

    stamp: int
    T_odom_body: Array
    covariance: Array
    twist: Array

    @classmethod
    def of_lidar(cls, result: OdometryResult) -> BodyMotion:
        return cls(result.stamp, result.T_odom_lidar, result.covariance, result.twist)

    def of_other(self, T_other_body: Array) -> BodyMotion:
        """The motion of another frame of the same rigid body, in the same odometry frame."""
        A = se3.adjoint(T_other_body)
        T_odom_other = self.T_odom_body @ se3.inverse(T_other_body)
        return BodyMotion(self.stamp, T_odom_other, A @ self.covariance @ A.T, A @ self.twist)

    def of_base(self, T_base_body: Array, T_start_odom: Array) -> BodyMotion:
        """The motion of the base, in an odometry frame that begins at its first pose; T_start_odom: odom in it."""
        moved = self.of_other(T_base_body)
        return replace(moved, T_odom_body=T_start_odom @ moved.T_odom_body)


def odometry_to_msg(
    motion: BodyMotion, covariance: Array, seconds: float, odom_frame: str, body_frame: str
) -> Odometry:
    """nav_msgs/Odometry at the cloud's stamp.

    Args:
        covariance: (6, 6) of the pose since the start, as in `Registration`.
        seconds: duration of the last step, to convert its covariance to that of the twist.
    """
    message = edge_to_msg(motion.T_odom_body, covariance, motion.stamp, odom_frame, body_frame)
    message.twist.twist = Twist(linear=vector(motion.twist[3:]), angular=vector(motion.twist[:3]))
    message.twist.covariance = covariance_to_ros(motion.covariance, np.eye(3)) / seconds**2
    return message


def cloud_to_msg(points: Points, stamp: int, frame_id: str) -> PointCloud2:
    """(N, 4) float32 to sensor_msgs/PointCloud2 with x, y, z, intensity."""
    return columns_to_msg(point_columns(points), stamp, frame_id)


def columns_to_msg(columns: Mapping[str, NDArray[Any]], stamp: int, frame_id: str) -> PointCloud2:
    """Fields and their values, as `cloud_fields` takes them, to sensor_msgs/PointCloud2."""
    fields = cloud_fields(columns, PointField)
    # array.frombytes takes 0.1 ms for 2 MB, assigning bytes twice that, a numpy array 100 ms (each byte is checked).
    return PointCloud2(header=header(stamp, frame_id), **(fields | {"data": bytes_to_array(fields["data"].data)}))


def bytes_to_array(data: bytes | memoryview) -> array.array[int]:
    """An array of the bytes: the type that is assigned fastest to the data of a message."""
    out = array.array("B")
    out.frombytes(data)
    return out


def keyframe_name(robot: str, id: int, session: str = "") -> str:
    """Name of a keyframe: `kf_12`, in a namespace `robot/kf_12`, of one drive `robot/kf_12.5f3a9c01`."""
    name = f"kf_{id}.{session}" if session else f"kf_{id}"
    return f"{robot}/{name}" if robot else name


def parse_keyframe_name(name: str) -> tuple[str, int, str]:
    """Robot, id and session.

    Raises:
        RejectedError: it is not the name of a keyframe.
    """
    found = _KEYFRAME_NAME.fullmatch(name)
    if found is None or int(found["id"]) > MAX_ID:
        raise RejectedError("name", f"{name[:80]!r} is no keyframe; want ROBOT/kf_NUMBER.SESSION")
    return found["robot"] or "", int(found["id"]), found["session"] or ""


def check_frame(name: str) -> None:
    """Raises RejectedError unless it can be the name of a frame."""
    if not _FRAME_NAME.fullmatch(name):
        raise RejectedError("frame", f"{name[:80]!r} is not the name of a frame")


def edge_to_msg(T: Array, covariance: Array, stamp: int, parent: str, child: str) -> Odometry:
    """A measured transform with its covariance (the core's): keyframe poses and loop closures."""
    message = Odometry(header=header(stamp, parent), child_frame_id=child)
    message.pose.pose = pose_to_msg(T)
    message.pose.covariance = covariance_to_ros(covariance, T[:3, :3])
    return message


def keyframe_to_base(keyframe: Keyframe, T_base_lidar: Array, T_start_odom: Array) -> Keyframe:
    """The keyframe in the base's frame: its pose, in an odometry frame that begins at the base's first pose (see
    `of_base`), cloud and LiDAR origin, descriptors, edge, fix and thumbnail."""
    edge, A = keyframe.edge, se3.adjoint(T_base_lidar)
    if edge is not None:
        T_before_this = T_base_lidar @ edge.T_target_source @ se3.inverse(T_base_lidar)
        edge = replace(edge, T_target_source=T_before_this, covariance=A @ edge.covariance @ A.T)
    fix = keyframe.fix
    if fix is not None:
        fix = fix.moved(T_base_lidar)
    thumbnail = keyframe.thumbnail
    return replace(
        keyframe,
        fix=fix,
        thumbnail=None if thumbnail is None else moved_thumbnail(thumbnail, T_base_lidar),
        T_odom_kf=T_start_odom @ keyframe.T_odom_kf @ se3.inverse(T_base_lidar),
        up=None,  # a base is level
        cloud=se3.transform(T_base_lidar, keyframe.cloud),
        origin=T_base_lidar[:3, :3] @ keyframe.origin + T_base_lidar[:3, 3],
        edge=edge,
        descriptors=None if keyframe.descriptors is None else keyframe.descriptors.moved(T_base_lidar),
    )
