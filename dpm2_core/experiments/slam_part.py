# SPDX-License-Identifier: Apache-2.0
"""One method on one sequence: our SLAM, another program, or a trajectory from a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import TypedDict

import numpy as np

from dpm2_core.config import load_settings
from dpm2_core.console import Advance
from dpm2_core.data.corrupt import CorruptedSource, parse_corruption
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import Source, Span, digest_of
from dpm2_core.data.trajectory import (
    Keys,
    Trajectory,
    interpolate,
    matched,
    placed,
    read_trajectory,
    same_stamps,
    write_tum,
)
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.ground_truth import camera_poses, lidar_poses, read_ground_truth
from dpm2_core.evaluation.kitti_metric import known
from dpm2_core.evaluation.machine import processors
from dpm2_core.evaluation.metrics import Metrics, evaluate
from dpm2_core.evaluation.run_folder import FRAMES, METRICS, TIMING, TRAJECTORY, TRUTH, write_frames, write_truth
from dpm2_core.experiments.peers import at_stamps, end_of, make_peer
from dpm2_core.files import write_json
from dpm2_core.fleet.drives import driven
from dpm2_core.fleet.part import Figures
from dpm2_core.frame import Array
from dpm2_core.pipeline import OfflineRun, open_recording, span_of
from dpm2_core.slam.settings import Config

OWN = "dpm2_core.experiments.slam_part:own"
PEER = "dpm2_core.experiments.slam_part:peer"
GIVEN = "dpm2_core.experiments.slam_part:given"


class Drive(TypedDict):
    """A drive to run: root of the data set, settings KEY=VALUE of `Config`, positions of the first frame and of the one
    after the last, and the segment lengths of the KITTI metric, m."""

    data: Path
    settings: Sequence[str]
    frames: Span
    lengths: Sequence[float]


def own(folder: Path, advance: Advance, drive: Drive, corrupt: str | None = None) -> Figures:
    """Run our SLAM; writes the files of `dpm2 run` except the map's points.

    Raises:
        UsageError: no such sequence, no ground truth, or unknown settings. Dpm2Error: files not written.
    """
    config = load_settings(Config, None, drive["settings"])
    source: Source | Path = drive["data"]
    if corrupt is not None:
        source = CorruptedSource(open_drive(drive["data"], drive["settings"]), parse_corruption(corrupt))
    with OfflineRun(source, config, drive["frames"]) as run:
        result = driven(run, advance)
        result.lengths = tuple(drive["lengths"])
        if result.metrics is None:
            raise UsageError(f"{run.source.name}: fewer than two frames with a ground truth to compare with")
        result.save(folder, cloud=False)
        seconds = {stage: float(np.sum(times)) for stage, times in result.seconds.items()}
        accepted = sum(loop.ok for loop in result.mapper.loops)
        return {
            **result.metrics.model_dump(exclude={"per_length", "per_speed"}),
            "states": dict(result.states),
            "loops": {"accepted": accepted, "rejected": len(result.mapper.loops) - accepted},
            "stage_ms": {stage: round(1e3 * total / len(result), 3) for stage, total in seconds.items()},
        }


def peer(folder: Path, advance: Advance, drive: Drive, name: str) -> Figures:
    """Run another program on the same frames, read one at a time, on all processors; its poses are those at the stamps.

    Raises:
        UsageError: it is not installed, or as `own`. Dpm2Error: it returned another number of poses than frames.
    """
    source = open_drive(drive["data"], drive["settings"], images=False)
    start, stop = span_of(source, drive["frames"])
    program, stamps, ends, index, seconds = None, list[int](), list[int](), list[int](), list[float]()
    for frame in prefetch(source.frames(start, stop)):
        if program is None:
            program = make_peer(name, processors(), frame.time_offset is not None)
        began = perf_counter()
        program.add(frame)
        seconds.append(perf_counter() - began)
        stamps.append(frame.stamp)
        ends.append(end_of(frame))
        index.append(frame.index)
        advance(len(stamps), stop - start)
    assert program is not None  # there are frames
    poses = program.poses()
    if len(poses) != len(stamps):
        raise Dpm2Error(f"{name}: {len(poses)} poses for {len(stamps)} frames")
    if program.at_end:  # ground truth is at the stamps
        poses = at_stamps(poses, ends, stamps)
    write_tum(folder / TRAJECTORY, stamps, poses)
    write_frames(folder / FRAMES, [(i, s, "", name) for i, s in zip(index, stamps, strict=True)],
                 {"total": seconds})  # fmt: skip
    truth = _true_poses(source, start, stop)
    write_truth(folder / TRUTH, stamps, truth)
    fps = len(seconds) / sum(seconds)
    write_json(folder / TIMING, {"frames": len(stamps), "fps": fps})
    return _write_metrics(folder, source, (stamps, truth, poses), drive, fps)


def given(folder: Path, advance: Advance, drive: Drive, file: Path) -> Figures:
    """Measure a trajectory from a file: TUM, of the LiDAR by stamp, or KITTI's, of the left camera.

    Raises:
        UsageError: no such file, or no pose in it is of the sequence.
    """
    source = open_drive(drive["data"], drive["settings"], images=False)
    start, stop = span_of(source, drive["frames"])
    truth = _true_poses(source, start, stop)
    # Only names and stamps are needed, but a source provides them only with its frames.
    keys = [(frame.index, frame.stamp) for frame in prefetch(source.frames(start, stop))]
    index, stamps = (np.array(column, np.int64) for column in zip(*keys, strict=True))
    poses = _read_poses(file, source, (start, stop), truth, {"tum": stamps, "kitti-indexed": index})
    if not known(poses).any():
        raise UsageError(f"{file}: has no pose during the frames of {source.name}")
    is_known = known(poses)
    write_tum(folder / TRAJECTORY, stamps[is_known].tolist(), poses[is_known])
    write_truth(folder / TRUTH, stamps.tolist(), truth)
    advance(len(truth), len(truth))
    return _write_metrics(folder, source, (stamps, truth, poses), drive, None)


def _read_poses(file: Path, source: Source, span: tuple[int, int], truth: Array, keys: dict[str, Keys]) -> Array:
    """Poses (N, 4, 4) of the LiDAR for the frames of a span, with true poses `truth` and `keys`; NaN for none.

    Raises:
        UsageError: no such file, or it is of other frames.
    """
    found = read_trajectory(file)
    if found.kind == "kitti" and len(found) != len(truth):  # of the whole recording, or of a longer one
        all_poses = read_ground_truth(source, file, *span)
        assert isinstance(all_poses, np.ndarray)
        return all_poses
    own_keys = keys.get(found.kind, np.arange(len(truth), dtype=np.int64))
    if found.kind == "tum":  # may be of some frames only, such as keyframes: between these nothing is known
        same = same_stamps(own_keys, found.keys)
        return placed(found, own_keys) if same else interpolate(found.keys, found.poses, own_keys)
    try:
        _, poses, _ = matched(Trajectory(truth, own_keys, found.kind), found)
    except UsageError as error:
        raise UsageError(f"{file}: {error}") from None
    if len(poses) != len(truth):
        raise UsageError(f"{file}: {len(poses)} poses for the {len(truth)} frames of {source.name}")
    return lidar_poses(poses, source.T_cam_lidar)


def _true_poses(source: Source, start: int, stop: int) -> Array:
    if source.poses is None:
        raise UsageError(f"{source.name}: no ground truth to compare with")
    return source.poses[start:stop]


def _write_metrics(
    folder: Path, source: Source, poses: tuple[Sequence[int] | Keys, Array, Array], drive: Drive, fps: float | None
) -> Figures:
    """Figures of stamps (N,) ns, true and estimated poses (N, 4, 4) of the LiDAR; they are those of KITTI's left camera
    if its extrinsics are known."""
    stamps, *pair = poses
    truth, est = (camera_poses(each, source.T_cam_lidar) for each in pair)
    metrics: Metrics = evaluate(truth, est, tuple(drive["lengths"]), stamps=np.asarray(stamps, np.int64))
    metrics = metrics.model_copy(update={"truth": source.truth, "fps": fps})
    write_json(folder / METRICS, metrics.model_dump())
    return metrics.model_dump(exclude={"per_length", "per_speed"})


def open_drive(data: Path, settings: Sequence[str], images: bool = True) -> Source:
    """A drive, read with the settings KEY=VALUE of `Config`; see `open_recording`."""
    return open_recording(data, load_settings(Config, None, settings), images)


def drive_content(data: Path, settings: Sequence[str]) -> str:
    """Digest of the content of a drive, see `digest_of`."""
    return digest_of(open_drive(data, settings))


def has_sequence(data: Path, settings: Sequence[str]) -> str:
    """Why a sequence cannot be opened; empty if it can."""
    config = load_settings(Config, None, settings)
    try:
        open_recording(data, config, images=False)
    except UsageError as error:
        return str(error)
    return ""
