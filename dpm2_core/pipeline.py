# SPDX-License-Identifier: Apache-2.0
"""Runs a recording through the SLAM at full speed, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from time import perf_counter

from dpm2_core.data.open import open_source
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import Source, Span
from dpm2_core.data.time_order import frames_in_order, note_corrected
from dpm2_core.data.trajectory import Trajectory
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.ground_truth import read_ground_truth
from dpm2_core.evaluation.run_result import Result
from dpm2_core.frame import Array, Frame
from dpm2_core.interrupt import interrupt_deferred
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.session import MapMode, open_map, resume_at
from dpm2_core.slam.settings import Config
from dpm2_core.slam.store.map_file import remove_map
from dpm2_core.slam.system import SlamResult

Watch = Callable[[Frame, SlamResult, Mapper], None]
"""Receives a frame, the result of the SLAM for it, and the map at that time."""


class OfflineRun:
    """One drive through the SLAM. A context manager: on exit it closes the map file, if there is one.

    Attributes:
        source: the recording. slam: the SLAM that processes it.
    """

    def __init__(
        self,
        source: Source | Path | str,
        config: Config | None = None,
        frames: Span = (0, None),
        ground_truth: Path | str | None = None,
        map_file: Path | str | None = None,
        map_mode: MapMode = "create",
    ) -> None:
        """Open everything that the run needs; only the beginning of the map file is written yet.

        Args:
            source: a recording, or the path of one, which is then opened with `config.input`.
            ground_truth: file of poses (KITTI: left camera; TUM: LiDAR); default: the ground truth of the source.
            map_file: written during the drive; with "localize" it is only read.

        Raises:
            UsageError: no such recording, no frames in that span, ground truth of another drive, no such weights, or a
                map file that exists already, is missing or does not fit. Dpm2Error: it cannot be read or written.
        """
        self._config = config or Config()
        self._resources = ExitStack()
        self._truth: Array | Trajectory | None = None
        self._has_run = False
        map_file = None if map_file is None else Path(map_file)
        # A new map file without a frame yet.
        self._new_map = None if map_file is None or map_file.exists() else map_file
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
                if self._start >= self._stop:
                    ends = self.slam.mapper.keyframes[-1].index
                    raise UsageError(f"--frames {frames[0]}:{frames[1]}: the map goes on to frame {ends} already")
            if map_mode != "localize":  # a map has its own frame
                self._truth = read_ground_truth(self.source, ground_truth, self._start, self._stop)
        except BaseException as error:
            self.__exit__(type(error))
            raise
        self._truth_name = self.source.truth if ground_truth is None else str(ground_truth)

    def __enter__(self) -> OfflineRun:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        self.close()
        if error is not None and self._new_map is not None:
            remove_map(self._new_map)  # else the corrected command would fail, since the map file exists

    def __len__(self) -> int:
        """Number of frames to be processed."""
        return self._stop - self._start

    def close(self) -> None:
        """Close the map file; save the `Result` before."""
        self._resources.close()

    def run(
        self,
        progress: Callable[[SlamResult], None] = lambda result: None,
        watch: Watch | None = None,
    ) -> Result:
        """Process all frames, once. Ctrl-C ends the run after a frame; the result has the frames up to then.

        Args:
            progress: called after each frame. watch: the same, with the frame and the map at that time.

        Raises:
            Dpm2Error: none of the scans could be read. UsageError: this object was run before.
        """
        if self._has_run:
            raise UsageError(f"{self.source.name}: it was run already; a second run needs another OfflineRun")
        self._has_run = True
        result = Result(self.source, self._config, self.slam.mapper, self._truth, self._truth_name)
        began, problems = perf_counter(), list[str]()
        with interrupt_deferred() as interrupted:
            try:
                corrected = partial(note_corrected, self.source.notes)
                for frame in prefetch(frames_in_order(self.source, self._start, self._stop, corrected)):
                    if frame.problem is None:
                        self._new_map = None
                    else:
                        problems.append(frame.problem)
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
        if problems and len(problems) == len(result) and not result.interrupted:
            raise Dpm2Error(f"{self.source.name}: none of {len(result)} scans could be read; the first: {problems[0]}")
        return result


def open_recording(path: Path | str, config: Config, images: bool) -> Source:
    """The recording, opened with `config.input`; with `images` False without its images.

    Raises:
        UsageError: no readable recording is there.
    """
    # Decoding images that are not used would only cost time.
    return open_source(path, config.input.model_copy(update={"images": images and config.input.images}))


def span_of(source: Source, frames: Span) -> tuple[int, int]:
    """Positions in the source of the first frame and of the frame after the last one.

    Raises:
        UsageError: the source has no frames in that span.
    """
    start, stop = frames[0], len(source) if frames[1] is None else min(frames[1], len(source))
    if start >= stop:
        requested = f"{frames[0]}:{'' if frames[1] is None else frames[1]}"
        raise UsageError(f"--frames {requested}: {source.name} has {len(source)} frames")
    return start, stop
