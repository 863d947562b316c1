# SPDX-License-Identifier: Apache-2.0
"""A tree of static transforms from /tf_static or configuration, without ROS. Missing ones are never identity."""

from __future__ import annotations

from collections.abc import Collection
from itertools import takewhile
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dpm2_core.data.messages import rigid_parts
from dpm2_core.data.naming import frame_name
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

_MAX_LISTED = 20  # largest number of frames named in an error


def transform_matrix(transform: Any) -> Array:
    """geometry_msgs/Transform or Pose to (4, 4).

    Raises:
        UsageError: the quaternion is zero or anything is not finite.
    """
    quaternion, translation = rigid_parts(transform)
    return se3.make(Rotation.from_quat(quaternion).as_matrix(), translation)


class TransformTree:
    """Frames by name, each with its parent frame."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, tf_message: Any) -> list[str]:
        """Add every rigid transform of a tf2_msgs/TFMessage; returns the problems of the others."""
        problems = []
        for stamped in tf_message.transforms:
            parent, child = stamped.header.frame_id, stamped.child_frame_id
            try:
                self.set(parent, child, transform_matrix(stamped.transform))
            except UsageError as error:
                problems.append(f"tf {parent} -> {child}: {error}")
        return problems

    def copy(self) -> TransformTree:
        """A copy of the tree that later changes do not affect."""
        tree = TransformTree()
        tree._parents = dict(self._parents)
        return tree

    def __len__(self) -> int:
        return len(self._parents)

    def parent(self, frame: str) -> tuple[str, Array] | None:
        """Parent frame and T_parent_frame (4, 4); None if the frame has no parent."""
        return self._parents.get(frame_name(frame))

    def set(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Set the transform of `child` in `parent`; a later call replaces an earlier one."""
        self._parents[frame_name(child)] = (frame_name(parent), np.asarray(T_parent_child, np.float64))

    def lookup(self, target_frame: str, source_frame: str) -> Array:
        """T_target_source (4, 4).

        Raises:
            UsageError: the two are not connected; the message names both, and the known frames.
        """
        target, source = frame_name(target_frame), frame_name(source_frame)
        up_target, up_source = self._ancestors(target), self._ancestors(source)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None or (target == source and target not in self.frames):
            frames = self.frames
            more = f" and {len(frames) - _MAX_LISTED} more" if len(frames) > _MAX_LISTED else ""
            known = (", ".join(frames[:_MAX_LISTED]) or "none") + more
            raise UsageError(f"no transform from {source_frame!r} to {target_frame!r}; frames known: {known}")
        return se3.inverse(up_target[common]) @ up_source[common]

    def between(self, target_frame: str, source_frame: str) -> Array:
        """T_target_source (4, 4) like `lookup`, but the identity for equal, non-empty names, even of unknown frames.

        Not for cameras: if an image names the LiDAR's frame, its axes are still not those of the LiDAR.

        Raises:
            UsageError: the two are not connected.
        """
        if frame_name(target_frame) and frame_name(target_frame) == frame_name(source_frame):
            return np.eye(4)
        return self.lookup(target_frame, source_frame)

    def root(self, frame: str, below: Collection[str] = ()) -> str:
        """The topmost ancestor of `frame` before any frame named in `below`; `frame` itself if it has none."""
        first, *above = self._ancestors(frame_name(frame))
        return [first, *takewhile(lambda name: name not in below, above)][-1]

    @property
    def frames(self) -> list[str]:
        """Names of every frame, sorted."""
        return sorted({*self._parents, *(parent for parent, _ in self._parents.values())})

    def _ancestors(self, frame: str) -> dict[str, Array]:
        """The frame itself and all its ancestors, nearest first, each with T_ancestor_frame."""
        out, T = {frame: np.eye(4)}, np.eye(4)
        while frame in self._parents:
            frame, T_parent_frame = self._parents[frame]
            if frame in out:
                break  # a cycle: invalid input must not cause an endless loop
            T = T_parent_frame @ T
            out[frame] = T
        return out
