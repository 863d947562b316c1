# SPDX-License-Identifier: Apache-2.0
"""The result of a run: its trajectory compared with the ground truth, its times, and the files that it writes."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.config import dump_settings
from dpm2_core.data.ply import write_ply
from dpm2_core.data.source import Source
from dpm2_core.data.trajectory import Keys, Trajectory, matched, write_kitti, write_tum
from dpm2_core.errors import UsageError
from dpm2_core.estimates import BETWEEN, OdometryResult
from dpm2_core.evaluation.figures import trajectory_png
from dpm2_core.evaluation.ground_truth import camera_poses, truth_by_stamp
from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS, known
from dpm2_core.evaluation.metrics import Metrics, evaluate
from dpm2_core.evaluation.run_folder import (
    CLOUD,
    FRAMES,
    GRAPH,
    LOCALIZATION,
    LOOPS,
    METRICS,
    PICTURE,
    POSES,
    TIMING,
    TRAJECTORY,
    TRUTH,
    remove_results,
    write_frames,
    write_loops,
    write_truth,
)
from dpm2_core.extras import MissingPackageError
from dpm2_core.files import atomic_write, make_folder, write_json
from dpm2_core.frame import Array, Points
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.output import TrajectoryRecorder
from dpm2_core.slam.settings import Config


@dataclass(eq=False)
class Result:
    """The result of a run. Clouds of the map stay in the map file, if there is one: save before the run is closed.

    Attributes:
        ground_truth: LiDAR poses (N, 4, 4) of the frames, or a trajectory to match by stamp or number, or None.
        ground_truth_name: what it was read from.
        recorder: the odometry's pose of every frame.
        imu: number of frames by the reason why the IMU was unusable, "used" if it was used; empty without an IMU.
        problems: number of frames by the problem with an image or with the times of their points, in words.
        frame_methods: registration method of each frame, "failed" if it failed. frame_states: state after each frame.
        seconds: wall time of each frame by stage; 0 for a stage that the frame did not pass.
        wall_s: of the whole run, reading included.
        lengths: of the KITTI metric's segments, m.
    """

    source: Source
    config: Config
    mapper: Mapper
    ground_truth: Array | Trajectory | None
    ground_truth_name: str
    recorder: TrajectoryRecorder = field(default_factory=TrajectoryRecorder)
    imu: Counter[str] = field(default_factory=Counter)
    problems: Counter[str] = field(default_factory=Counter)
    frame_methods: list[str] = field(default_factory=list)
    frame_states: list[str] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=dict)
    wall_s: float = 0.0
    lengths: tuple[float, ...] = OFFICIAL_LENGTHS
    interrupted: bool = False

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.recorder)

    def add(self, tracked: OdometryResult) -> None:
        """Add the next frame."""
        self.recorder.add(tracked)
        self.frame_methods.append("failed" if tracked.failed else tracked.registration.method)
        self.frame_states.append(str(tracked.state))
        if tracked.imu is not None:
            self.imu[tracked.imu or "used"] += 1
        self.problems.update(problem for problem in (tracked.camera, tracked.times) if problem)
        for stage in {**self.seconds, **tracked.seconds}:  # parts of a sweep pass only some stages
            times = self.seconds.setdefault(stage, [0.0] * (len(self) - 1))
            times.append(tracked.seconds.get(stage, 0.0))

    @property
    def registered(self) -> list[bool]:
        """Of each frame, whether its registration succeeded."""
        return [method not in ("failed", BETWEEN) for method in self.frame_methods]

    @property
    def methods(self) -> Counter[str]:
        """Number of frames by registration method; "failed" for those that were not registered."""
        return Counter(self.frame_methods)

    @property
    def states(self) -> Counter[str]:
        """Number of frames in each state."""
        return Counter(self.frame_states)

    @cached_property
    def poses(self) -> Array:
        """(N, 4, 4) T_map_lidar of all frames after all corrections; read when the run has ended.

        Raises:
            UsageError: the run has localized, and made no map.
        """
        keyframes = self.mapper.poses[self.mapper.session_start :]
        if len(keyframes) != self.recorder.keyframes:
            raise UsageError(
                "a localization run has no corrected poses: use T_map_lidar of each result, which `progress` receives"
            )
        return self.recorder.poses(keyframes)

    @property
    def sensor_poses(self) -> Array:
        """(N, 4, 4) poses of the left camera, as in KITTI; of the LiDAR if the calibration is not known."""
        return camera_poses(self.poses, self.source.T_cam_lidar)

    @property
    def connected(self) -> bool:
        """Whether the pose of this drive in the map is known; True if there was no map before."""
        first = self.mapper.session_start
        return first == 0 or bool(self.mapper.placed[first:].any())

    @property
    def fps(self) -> float:
        """Frames per second of processing only; 0 without frames."""
        total = self._frame_seconds
        return len(total) / float(total.sum()) if len(total) else 0.0

    @property
    def _frame_seconds(self) -> Array:
        return np.asarray(np.sum(list(self.seconds.values()), axis=0)) if self.seconds else np.zeros(0)

    @property
    def timing(self) -> dict[str, Any]:
        """Content of timing.json; the times of the stages are those of whole sweeps."""
        whole = [method != BETWEEN for method in self.frame_methods]
        stages = {**self.seconds, "total": self._frame_seconds.tolist()}
        return {
            "frames": len(self),
            "fps": self.fps,
            "wall_s": self.wall_s,
            "answers": dict(self.methods),
            "states": dict(self.states),
            "breaks": self.recorder.breaks,
            **({"imu": dict(self.imu)} if self.imu else {}),
            **({"problems": dict(self.problems)} if self.problems else {}),
            "stages_ms": {stage: _time_summary([*compress(times, whole)]) for stage, times in stages.items()},
        }

    @cached_property
    def metrics(self) -> Metrics | None:
        """Metrics against the ground truth; None without ground truth.

        Raises:
            UsageError: no pose of the ground truth is of this drive.
        """
        if not len(self):
            return None
        truth, poses, stamps = self._matched_poses()
        if truth is None:
            return None
        if not isinstance(self.ground_truth, Trajectory):
            if known(truth).sum() < 2:
                return None
            poses = self.sensor_poses
            truth = camera_poses(truth, self.source.T_cam_lidar)
        metrics = evaluate(truth, poses, self.lengths, stamps=stamps, failed_frames=self.methods["failed"])
        own = {"truth": self.ground_truth_name, "frames": len(self), "breaks": self.recorder.breaks, "fps": self.fps}
        return metrics.model_copy(update=own)

    def save(self, out: Path | str, cloud: bool = True) -> list[str]:
        """Write all files, each completely or not at all; returns what could not be done, in words.

        Files of an earlier run that this run does not write are removed.

        Args:
            cloud: write map.ply, too, and draw the map in trajectory.png; a long drive's takes hundreds of megabytes.

        Raises:
            Dpm2Error: a file could not be written; the old one is kept, and map.ply comes after the figures.
            UsageError: no folder can be made there, or, once all other files are written, see `metrics`.
        """
        out = Path(out)
        make_folder(out)
        remove_results(out, METRICS, TRUTH, PICTURE, LOCALIZATION)  # also if the truth does not fit
        save_config(self.config, out)
        write_kitti(out / POSES, self.sensor_poses)
        write_tum(out / TRAJECTORY, self.recorder.stamps, self.poses)
        self.mapper.graph.write_g2o(out / GRAPH)
        keys = zip(self.recorder.index, self.recorder.stamps, self.frame_states, self.frame_methods, strict=True)
        write_frames(out / FRAMES, list(keys), self.seconds)
        write_loops(out / LOOPS, self.mapper.loops, self.mapper.poses)
        write_json(out / TIMING, self.timing)
        try:
            if self.metrics is not None:
                write_json(out / METRICS, self.metrics.model_dump())
                assert self.ground_truth is not None
                write_truth(out / TRUTH, *truth_by_stamp(self.ground_truth, self.recorder.stamps, self.recorder.index,
                                                         self.source.T_cam_lidar))  # fmt: skip
        finally:  # the largest file last: if it does not fit on the disk, the figures of the run are written
            points = self.mapper.cloud() if cloud else None
            if points is None:
                remove_results(out, CLOUD)
            else:
                write_ply(out / CLOUD, points)
            missing = self._draw(out / PICTURE, points)
        return missing

    def _draw(self, path: Path, points: Points | None) -> list[str]:
        """Write trajectory.png; returns why it is missing."""
        if not len(self):
            return ["no trajectory.png: no frame was processed"]
        try:
            truth, poses, _ = self._matched_poses()
        except UsageError:  # the truth is of another drive
            truth, poses = None, self.poses
        title = f"{self.source.name}: {len(self)} frames"
        try:
            trajectory_png(path, poses, truth, points, title)
        except MissingPackageError as error:
            return [f"no trajectory.png: {error}"]
        return []

    def _matched_poses(self) -> tuple[Array | None, Array, Keys]:
        """Ground truth and estimate (M, 4, 4) of the same frames, and their stamps (M,), ns."""
        truth, stamps = self.ground_truth, np.array(self.recorder.stamps)
        if not isinstance(truth, Trajectory):
            return None if truth is None else truth[: len(self)], self.poses, stamps
        if truth.kind == "tum":
            true, est, stamps = matched(truth, Trajectory(self.poses, stamps, "tum"))
        else:
            index = np.array(self.recorder.index)
            true, est, numbers = matched(truth, Trajectory(self.sensor_poses, index, truth.kind))
            stamps = np.interp(numbers, index, stamps).astype(np.int64)
        known_frames = np.flatnonzero(
            known(est)
        )  # all frames have a pose: the truth before and after is not of this drive
        drive = slice(known_frames[0], known_frames[-1] + 1)
        return true[drive], est[drive], stamps[drive]

    @property
    def sensor(self) -> str:
        """Sensor whose poses are compared with the truth."""
        stamped = isinstance(self.ground_truth, Trajectory) and self.ground_truth.kind == "tum"
        return "LiDAR" if stamped or self.source.T_cam_lidar is None else "left camera"


def save_config(config: Config, out: Path) -> None:
    """Write config.yaml, which `--config` reads back.

    Raises:
        Dpm2Error: it could not be written.
    """
    with atomic_write(out / "config.yaml") as file:
        file.write(dump_settings(config))


def _time_summary(times: list[float]) -> dict[str, float]:
    median, p95 = np.percentile(np.array(times) * 1e3, [50, 95]) if times else (0.0, 0.0)
    return {"median": round(float(median), 3), "p95": round(float(p95), 3)}
