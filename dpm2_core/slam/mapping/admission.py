# SPDX-License-Identifier: Apache-2.0
"""Checks keyframes before they enter a map: an invalid one would corrupt poses, clouds or the search of all others.

Called when a keyframe is received over the network, and again before the graph is changed.
"""

from __future__ import annotations

import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.store.cloud_codec import MAX_POINTS
from dpm2_core.slam.store.rows import MAX_ID, why_no_pose

MAX_DESCRIPTORS = 4096
_MAX_RANGE = 32_000.0  # m: the range of a packed cloud
_LARGEST_VARIANCE = 1e12  # m^2: of an unknown pose
_LARGEST_FEATURE = 1000.0  # trained networks give less than 10; more would outweigh all other places in the search


class RejectedError(UsageError):
    """A keyframe is rejected; `reason` is one of a few words, for counting; the text is one line."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def check_keyframe(keyframe: Keyframe, channels: int | None) -> None:
    """Reject a keyframe that could corrupt the map.

    Args:
        channels: width of the features of the map's network; None: any.

    Raises:
        RejectedError: id, pose, cloud, covariance of the edge, or descriptors.
    """
    if not 0 <= keyframe.id <= MAX_ID:
        raise RejectedError("id", f"keyframe {keyframe.id}: want an id from 0 to {MAX_ID}")
    check_pose(keyframe.T_odom_kf)
    check_cloud(keyframe.cloud)
    if not np.abs(keyframe.origin).max() <= _MAX_RANGE:  # false for NaN
        raise RejectedError("cloud", f"its cloud is seen from {keyframe.origin.tolist()} m")
    if keyframe.edge is not None:
        check_covariance(keyframe.edge.covariance)
    if keyframe.descriptors is not None:
        check_descriptors(keyframe.descriptors, channels)


def check_pose(T: Array) -> None:
    """Raises RejectedError unless (4, 4) is a rigid transform to a position nearer than `rows.FARTHEST`."""
    if why := why_no_pose(T):
        raise RejectedError("pose", f"its pose is {why}")


def check_covariance(covariance: Array) -> None:
    """Raises RejectedError unless (6, 6) is the covariance of a measured pose."""
    if not se3.is_covariance(covariance, largest=_LARGEST_VARIANCE):
        raise RejectedError("covariance", "its covariance is not finite, symmetric and positive definite")


def check_cloud(cloud: Points) -> None:
    """Raises RejectedError unless (M, 4) is a cloud that can be stored."""
    if cloud.ndim != 2 or cloud.shape[1] != 4 or len(cloud) > MAX_POINTS:
        raise RejectedError("cloud", f"its cloud has shape {cloud.shape}; want (M, 4), at most {MAX_POINTS} points")
    if not np.isfinite(cloud).all():
        raise RejectedError("cloud", "its cloud has coordinates that are not finite")
    if np.abs(cloud[:, :3]).max(initial=0.0) > _MAX_RANGE:
        raise RejectedError("cloud", f"its cloud reaches farther than {_MAX_RANGE / 1000:.0f} km")


def check_descriptors(d: Descriptors, channels: int | None) -> None:
    """Raises RejectedError unless they can be compared with those of a network with this number of `channels`."""
    count, width = d.features.shape
    if channels is not None and width != channels:
        raise RejectedError("descriptors", f"its descriptors have {width} channels, the map's network makes {channels}")
    if not 0 < count <= MAX_DESCRIPTORS or width > MAX_DESCRIPTORS:
        raise RejectedError("descriptors", f"{count} descriptors of {width} channels; want 1 to {MAX_DESCRIPTORS}")
    if d.axis is not None and d.axis.shape != (count, 2):
        raise RejectedError("descriptors", f"its descriptors have axes of shape {d.axis.shape}; want ({count}, 2)")
    parts = ((d.xyz, _MAX_RANGE), (d.step, _LARGEST_FEATURE / 127), (d.axes, 2.0))
    if not all(np.abs(part).max() <= limit for part, limit in parts):  # NaN compares false
        raise RejectedError("descriptors", "its descriptors are not finite, or too large")
