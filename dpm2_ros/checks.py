# SPDX-License-Identifier: Apache-2.0
"""Checks of sensor messages before they are queued for the worker: all others on their topics are rejected."""

from __future__ import annotations

from typing import Any

import numpy as np

from dpm2_core.data.livox import cloud_of_custom
from dpm2_core.data.messages import MessageError, check_cloud
from dpm2_core.data.transforms import TransformTree, transform_matrix
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.admission import RejectedError, check_pose
from dpm2_core.slam.store.cloud_codec import MAX_POINTS
from dpm2_ros.conversions import check_frame
from dpm2_ros.tf_message import MAX_TRANSFORMS

_MAX_BYTES = 1 << 28
_MAX_FRAMES = 2000
_POSE_TOLERANCE = 1e-3  # m, and of a rotation's matrix: two publishers of the same pose may differ by this


def check_header(header: Any) -> None:
    """Raises RejectedError unless stamp and frame are valid."""
    if header.stamp.sec < 0 or header.stamp.nanosec >= 10**9:
        raise RejectedError("stamp", f"invalid stamp of {header.stamp.sec} s and {header.stamp.nanosec} ns")
    if header.frame_id:
        check_frame(header.frame_id)


def check_size(message: Any, points: int = 0) -> None:
    """Raises RejectedError for a message that is larger than that of any sensor."""
    if len(message.data) > _MAX_BYTES or points > MAX_POINTS:
        raise RejectedError("size", f"too large: {len(message.data)} bytes, {points} points")


def checked_cloud(message: Any) -> tuple[Any, str]:
    """A PointCloud2, converted if the message is a serialized Livox CustomMsg; and why its points cannot be read, empty
    if they can.

    Raises:
        RejectedError, MessageError: it cannot be the cloud of a sensor.
    """
    if isinstance(message, bytes):
        message = cloud_of_custom(message)
    check_header(message.header)
    check_size(message, message.width * message.height)
    try:
        check_cloud(message)
    except (MessageError, ValueError, TypeError, OverflowError) as error:
        return message, str(error)
    return message, ""


def checked_pose(pose: Any) -> Array:
    """A geometry_msgs Pose or Transform as (4, 4).

    Raises:
        UsageError: it is not a rigid transform. RejectedError: it is longer than any map.
    """
    T = transform_matrix(pose)
    check_pose(T)
    return T


def check_transforms(message: Any) -> None:
    """Raises RejectedError for a TFMessage of more transforms than any robot sends at once."""
    if len(message.transforms) > MAX_TRANSFORMS:
        raise RejectedError("size", f"{len(message.transforms)} transforms; at most {MAX_TRANSFORMS} are read")


def extended(tree: TransformTree, message: Any) -> tuple[TransformTree, str]:
    """A tree with the valid transforms of a TFMessage added, and what is wrong with the last invalid one.

    Raises:
        RejectedError: there are too many.
    """
    check_transforms(message)
    tree, problem = tree.copy(), ""
    for stamped in message.transforms:
        parent, child = stamped.header.frame_id, stamped.child_frame_id
        try:
            check_frame(parent)
            check_frame(child)
            T_parent_child = checked_pose(stamped.transform)
            if len(tree) >= _MAX_FRAMES and tree.parent(child) is None:
                raise RejectedError("frame", f"there are {_MAX_FRAMES} frames already")
        except UsageError as error:
            problem = f"tf {parent[:80]!r} -> {child[:80]!r}: {error}"
        else:
            tree.set(parent, child, T_parent_child)
    return tree, problem


def replaced(before: TransformTree, after: TransformTree) -> str:
    """Which frames of a tree have another parent or pose in a second tree, in words; empty if none has."""
    changes = []
    for frame in before.frames:
        old, new = before.parent(frame), after.parent(frame)
        if old is None or new is None or old is new:
            continue
        if old[0] != new[0]:
            changes.append(f"{frame} has the parent {new[0]}, no longer {old[0]}")
        elif not np.allclose(old[1], new[1], atol=_POSE_TOLERANCE):
            meters, degrees = se3.apart(old[1], new[1])
            changes.append(f"{frame} has moved by {meters:.2f} m and {degrees:.1f} deg in {old[0]}")
    return "; ".join(changes)
