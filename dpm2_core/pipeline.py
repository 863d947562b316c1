# SPDX-License-Identifier: Apache-2.0
"""A recording through the SLAM at full speed, without ROS: `OfflineRun`, and the files that its `Result` writes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from dpm2_core.config import dump_settings
from dpm2_core.data.open import open_source
from dpm2_core.data.ply import write_ply
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import Source, Span
from dpm2_core.data.trajectory import SAME_TIME, Trajectory, frame_period, matched, write_kitti, write_tum
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.figures import trajectory_png
from dpm2_core.evaluation.ground_truth import in_other_frame, read_ground_truth, truth_by_stamp
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
from dpm2_core.frame import Array, Frame, OdometryResult, Points
from dpm2_core.interrupt import interrupt_deferred
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.output import TrajectoryRecorder
from dpm2_core.slam.session import MapMode, open_map, resume_at
from dpm2_core.slam.settings import Config
from dpm2_core.slam.store.map_store import remove_map
from dpm2_core.slam.system import SlamResult

Watch = Callable[[Frame, SlamResult, Mapper], None]
"""Looks at a frame, what became of it, and the map as it is then."""


class OfflineRun:
    """One drive through the SLAM. A context manager: leaving it closes the map file, if there is one.

    Attributes:
        source: the recording. slam: what it goes through.
    """

    def __init__(
        self,
        source: Source | Path | str,
        config: Config | None = None,
        frames: Span = (0, None),
        ground_truth: Path | None = None,
        map_file: Path | None = None,
        map_mode: MapMode = "create",
    ) -> None:
        """Open everything that the run needs; nothing is written yet but the beginning of the map file.

        Args:
            source: a recording, or the path of one, which is then opened with `config.input`.
            ground_truth: file of poses (KITTI: left camera; TUM: LiDAR); those of the source otherwise.
            map_file: written as the drive goes on; with "localize" read, and left as it is.

        Raises:
            UsageError: no such recording, no frames in that span, ground truth of another drive, no such weights, or a
                map file that is there already, is missing or does not fit. Dpm2Error: it cannot be read or written.
        """
        self._config = config or Config()
        self._resources = ExitStack()
        self._truth: Array | Trajectory | None = None
        self._begun = None if map_file is None or map_file.exists() else map_file  # a map file without a frame yet
        store = None if map_file is None else open_map(map_file, self._config, map_mode)
        if store is not None:
            self._resources.push(store)
        try:
            self.slam = make_slam(self._config.slam, store=store)
            if isinstance(source, (Path, str)):
                source = open_recording(source, self._config, self.slam.uses_images)
            self.source = source
            self._start, self._stop = span_of(self.source, frames)
            if map_mode == "resume":
                self._start = resume_at(self.slam.mapper, self.source, self._start)
                _check_span(self.source, self._start, self._stop, frames)
            if map_mode != "localize":  # the frame of the map is its own
                self._truth = read_ground_truth(self.source, ground_truth, self._start, self._stop)
        except BaseException as error:
            self.__exit__(type(error))
            raise
        self._truth_name = self.source.truth if ground_truth is None else str(ground_truth)

    def __enter__(self) -> OfflineRun:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        self.close()
        if error is not None and self._begun is not None:
            remove_map(self._begun)  # or the same command, with its mistake corrected, would find a map there

    def __len__(self) -> int:
        """Number of frames to be processed."""
        return self._stop - self._start

    def close(self) -> None:
        """Close the map file; a `Result` must be saved before."""
        self._resources.close()

    def run(
        self,
        progress: Callable[[SlamResult], None] = lambda result: None,
        watch: Watch | None = None,
    ) -> Result:
        """All frames through the SLAM, once; Ctrl-C ends it after a frame, and the result is of the frames until then.

        Args:
            progress: called after each frame. watch: the same, with the frame and the map as they are then.
        """
        result = Result(self.source, self._config, self.slam.mapper, self._truth, self._truth_name)
        self._begun, began = None, perf_counter()
        try:
            with interrupt_deferred() as interrupted:
                for frame in prefetch(self.source.frames(self._start, self._stop)):
                    step = self.slam.process(frame)
                    result.add(step.odometry)
                    if watch is not None:
                        watch(frame, step, self.slam.mapper)
                    progress(step)
                    if interrupted():
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            result.interrupted = True
        result.wall_s = perf_counter() - began
        self.slam.finish()
        return result


@dataclass(eq=False)
class Result:
    """What a run found. Clouds of the map stay in the map file, if there is one: save before the run is closed.

    Attributes:
        ground_truth: LiDAR poses (N, 4, 4) of the frames, or a trajectory to be matched by stamp or number, or None.
        ground_truth_name: what it was read from.
        recorder: the odometry's pose of every frame.
        imu: frames by why the IMU was of no use to them, "used" where it was; empty where there is none.
        frame_methods: of each frame, how it was registered, "failed" if it was not. frame_states: after each.
        seconds: wall time of each frame by stage.
        wall_s: of the whole run, reading included.
    """

    source: Source
    config: Config
    mapper: Mapper
    ground_truth: Array | Trajectory | None
    ground_truth_name: str
    recorder: TrajectoryRecorder = field(default_factory=TrajectoryRecorder)
    imu: Counter[str] = field(default_factory=Counter)
    frame_methods: list[str] = field(default_factory=list)
    frame_states: list[str] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=dict)
    wall_s: float = 0.0
    interrupted: bool = False

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.recorder)

    def add(self, tracked: OdometryResult) -> None:
        """Take in the next frame."""
        self.recorder.add(tracked)
        self.frame_methods.append(tracked.registration.method if tracked.registration.ok else "failed")
        self.frame_states.append(str(tracked.state))
        if tracked.imu is not None:
            self.imu[tracked.imu or "used"] += 1
        for stage, time in tracked.seconds.items():
            self.seconds.setdefault(stage, []).append(time)

    @property
    def registered(self) -> list[bool]:
        """Of each frame, whether its registration succeeded."""
        return [method != "failed" for method in self.frame_methods]

    @property
    def methods(self) -> Counter[str]:
        """How many frames were registered how; "failed" for those that were not."""
        return Counter(self.frame_methods)

    @property
    def states(self) -> Counter[str]:
        """Frames in each state."""
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
                "a run that localizes corrects no poses: look at T_map_lidar of each result, by `progress`"
            )
        return self.recorder.poses(keyframes)

    @property
    def sensor_poses(self) -> Array:
        """(N, 4, 4) of the left camera, as KITTI has them; of the LiDAR where the calibration is not known."""
        return self.poses if self.source.T_cam_lidar is None else in_other_frame(self.poses, self.source.T_cam_lidar)

    @property
    def connected(self) -> bool:
        """Whether a loop ties this drive to those that were in the map file before; True if there were none."""
        first = self.mapper.session_start
        return first == 0 or any(edge.from_node < first <= edge.to_node for edge in self.mapper.edges)

    @property
    def fps(self) -> float:
        """Frames per second of processing alone; 0 without frames."""
        total = self._frame_seconds
        return len(total) / float(total.sum()) if len(total) else 0.0

    @property
    def _frame_seconds(self) -> Array:
        return np.asarray(np.sum(list(self.seconds.values()), axis=0)) if self.seconds else np.zeros(0)

    @property
    def timing(self) -> dict[str, Any]:
        """Content of timing.json."""
        stages = {**self.seconds, "total": self._frame_seconds.tolist()}
        return {
            "frames": len(self),
            "fps": self.fps,
            "wall_s": self.wall_s,
            "answers": dict(self.methods),
            "states": dict(self.states),
            "breaks": self.recorder.breaks,
            **({"imu": dict(self.imu)} if self.imu else {}),
            "stages_ms": {stage: _summary(times) for stage, times in stages.items()},
        }

    @cached_property
    def metrics(self) -> Metrics | None:
        """Against the ground truth; None without any.

        Raises:
            UsageError: nothing of the ground truth belongs to this drive.
        """
        truth, poses = self._compared()
        if truth is None:
            return None
        if not isinstance(self.ground_truth, Trajectory):
            if np.isfinite(truth[:, 0, 0]).sum() < 2:
                return None
            poses = self.sensor_poses
            truth = truth if self.source.T_cam_lidar is None else in_other_frame(truth, self.source.T_cam_lidar)
        failed = self.methods["failed"]
        metrics = evaluate(truth, poses, period=frame_period(self.recorder.stamps), failed_frames=failed)
        own = {"truth": self.ground_truth_name, "breaks": self.recorder.breaks, "fps": self.fps}
        return metrics.model_copy(update=own)

    def save(self, out: Path, cloud: bool = True) -> list[str]:
        """Write all files, each whole or not at all; returns what could not be done, in words.

        Files of a run before, of which this one has none, are removed.

        Args:
            cloud: map.ply, too, and the map in trajectory.png; a long drive's takes hundreds of megabytes.

        Raises:
            Dpm2Error: a file could not be written; the old one survives. UsageError: see `metrics`, or no folder can
                be made there.
        """
        make_folder(out)
        save_config(self.config, out)
        write_kitti(out / POSES, self.sensor_poses)
        write_tum(out / TRAJECTORY, self.recorder.stamps, self.poses)
        points = self.mapper.cloud() if cloud else None
        if points is None:
            remove_results(out, CLOUD)
        else:
            write_ply(out / CLOUD, points)
        self.mapper.write_g2o(out / GRAPH)
        keys = zip(self.recorder.index, self.recorder.stamps, self.frame_states, self.frame_methods, strict=True)
        write_frames(out / FRAMES, list(keys), self.seconds)
        write_loops(out / LOOPS, self.mapper.loops, self.mapper.poses)
        write_json(out / TIMING, self.timing)
        if self.metrics is None:
            remove_results(out, METRICS, TRUTH)
        else:
            write_json(out / METRICS, self.metrics.model_dump())
            assert self.ground_truth is not None
            write_truth(out / TRUTH, *truth_by_stamp(self.ground_truth, self.recorder.stamps, self.recorder.index,
                                                     self.source.T_cam_lidar))  # fmt: skip
        missing = self._draw(out / PICTURE, points)
        remove_results(out, LOCALIZATION, *([PICTURE] if missing else []))
        return missing

    def _draw(self, path: Path, points: Points | None) -> list[str]:
        """Write trajectory.png; returns why there is none."""
        if not len(self):
            return ["no trajectory.png: no frame was processed"]
        truth, poses = self._compared()
        title = f"{self.source.name}: {len(self)} frames"
        try:
            trajectory_png(path, poses, truth, points, title)
        except MissingPackageError as error:
            return [f"no trajectory.png: {error}"]
        return []

    def _compared(self) -> tuple[Array | None, Array]:
        """Ground truth and estimate (M, 4, 4) of the same frames."""
        truth = self.ground_truth
        if not isinstance(truth, Trajectory):
            return None if truth is None else truth[: len(self)], self.poses
        own, apart = Trajectory(self.poses, np.array(self.recorder.stamps), "tum"), SAME_TIME * 1e9
        if truth.kind == "kitti-indexed":
            own, apart = Trajectory(self.sensor_poses, np.array(self.recorder.index), "kitti-indexed"), 0
        first, last = min(own.keys, default=0) - apart, max(own.keys, default=0) + apart
        during = (truth.keys >= first) & (truth.keys <= last)
        if during.any():  # else it is of another drive, which `matched` says
            truth = Trajectory(truth.poses[during], truth.keys[during], truth.kind)
        return matched(truth, own)

    @property
    def sensor(self) -> str:
        """Whose poses are compared with the truth."""
        stamped = isinstance(self.ground_truth, Trajectory) and self.ground_truth.kind == "tum"
        return "LiDAR" if stamped or self.source.T_cam_lidar is None else "left camera"


def save_config(config: Config, out: Path) -> None:
    """Write config.yaml, which `--config` reads back.

    Raises:
        Dpm2Error: it could not be written.
    """
    with atomic_write(out / "config.yaml") as file:
        file.write(dump_settings(config))


def open_recording(path: Path | str, config: Config, images: bool) -> Source:
    """The recording, opened with `config.input`; `images` False leaves those out.

    Raises:
        UsageError: there is none that can be read.
    """
    # Decoding images that are not used would only cost time.
    return open_source(path, config.input.model_copy(update={"images": images and config.input.images}))


def span_of(source: Source, frames: Span) -> tuple[int, int]:
    """Positions of the first frame and of the one after the last, within the source.

    Raises:
        UsageError: it has no frames there.
    """
    start, stop = frames[0], len(source) if frames[1] is None else min(frames[1], len(source))
    _check_span(source, start, stop, frames)
    return start, stop


def _check_span(source: Source, start: int, stop: int, frames: Span) -> None:
    if start >= stop:
        asked = f"{frames[0]}:{'' if frames[1] is None else frames[1]}"
        raise UsageError(f"--frames {asked}: {source.name} has {len(source)} frames")


def _summary(times: list[float]) -> dict[str, float]:
    median, p95 = np.percentile(np.array(times) * 1e3, [50, 95]) if times else (0.0, 0.0)
    return {"median": round(float(median), 3), "p95": round(float(p95), 3)}
