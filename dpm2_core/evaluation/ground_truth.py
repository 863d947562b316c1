# SPDX-License-Identifier: Apache-2.0
"""The true poses of a drive, from its source or from a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpm2_core.data.source import Source, frame_at, true_poses
from dpm2_core.data.trajectory import Trajectory, read_trajectory
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3


def read_ground_truth(source: Source, path: Path | str | None, start: int, stop: int) -> Array | Trajectory | None:
    """Ground truth of frames start..stop-1: LiDAR poses (N, 4, 4), a trajectory to match by stamp or number, or None.

    Args:
        path: file of poses (KITTI: left camera; TUM: LiDAR); None for those of the source.

    Raises:
        UsageError: no such file, or it is of another drive or of other frames; or as `true_poses`.
    """
    if path is None:
        poses = true_poses(source)
        return None if poses is None else poses[start:stop]
    truth = read_trajectory(path)
    if truth.kind != "kitti":
        _check_overlap(truth, path, source, start, stop)
        return truth
    numbers = getattr(source, "numbers", None)  # numbers in the file names; a bag has none
    if len(truth) < len(source) or (len(truth) > len(source) and numbers is None):
        raise UsageError(f"{path}: {len(truth)} poses for {len(source)} frames of {source.name}")
    if len(truth) > len(source):  # a file of the whole sequence for an excerpt
        numbers = np.asarray(numbers)[start:stop]
        if max(numbers) >= len(truth):
            raise UsageError(f"{path}: {len(truth)} poses, but {source.name} has frame {max(numbers)}")
        poses = truth.poses[numbers]
    else:
        poses = truth.poses[start:stop]
    return lidar_poses(poses, source.T_cam_lidar)


def _check_overlap(truth: Trajectory, path: Path | str, source: Source, start: int, stop: int) -> None:
    """Check before the run that the truth fits, as an error at its end would waste all its time.

    Raises:
        UsageError: all true poses are from before or after those frames.
    """
    stamped, begin, end = truth.kind == "tum", int(truth.keys.min()), int(truth.keys.max())

    def key_at(position: int) -> int:
        frame = frame_at(source, position)
        return frame.stamp if stamped else frame.index

    if begin <= (first := key_at(start)) <= end:  # the last frame of a bag is found only by reading all of it
        return
    first, last = sorted((first, key_at(stop - 1)))
    if end < first or begin > last:
        truth_range, frame_range = (
            f"from {a / 1e9:.3f} to {b / 1e9:.3f} s" if stamped else f"{a} to {b}"
            for a, b in ((begin, end), (first, last))
        )
        raise UsageError(f"{path}: poses {truth_range}, but the frames of {source.name} are {frame_range}")


def truth_by_stamp(
    truth: Array | Trajectory, stamps: Sequence[int], index: Sequence[int], T_cam_lidar: Array | None
) -> tuple[Sequence[int], Array]:
    """Stamps, ns, and true poses (M, 4, 4) of the LiDAR during a drive, given the stamps and numbers of its frames."""
    if not isinstance(truth, Trajectory):
        return stamps, truth[: len(stamps)]
    if truth.kind == "tum":
        during = (truth.keys >= stamps[0]) & (truth.keys <= stamps[-1])
        return truth.keys[during].tolist(), truth.poses[during]
    stamp_of = dict(zip(index, stamps, strict=True))
    found = [i for i, key in enumerate(truth.keys.tolist()) if key in stamp_of]
    return [stamp_of[int(truth.keys[i])] for i in found], lidar_poses(truth.poses[found], T_cam_lidar)


def camera_poses(poses: Array, T_cam_lidar: Array | None) -> Array:
    """Convert LiDAR poses (N, 4, 4) to those of the left camera, as in KITTI; unchanged without its extrinsics."""
    return poses if T_cam_lidar is None else _in_other_frame(poses, T_cam_lidar)


def lidar_poses(poses: Array, T_cam_lidar: Array | None) -> Array:
    """The inverse of `camera_poses`: poses of the LiDAR from those of the left camera."""
    return poses if T_cam_lidar is None else _in_other_frame(poses, se3.inverse(T_cam_lidar))


def _in_other_frame(poses: Array, T_other_sensor: Array) -> Array:
    """Convert poses of one sensor to those of another that is rigidly mounted to it."""
    return T_other_sensor @ poses @ se3.inverse(T_other_sensor)
