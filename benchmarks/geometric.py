# SPDX-License-Identifier: Apache-2.0
"""The geometric SLAM compared with KISS-ICP: the same scans, processors and process, in turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from time import perf_counter, process_time
from typing import Any

import numpy as np
from rich.console import Group

from benchmarks.harness import Options, Report, drives, installed, processors, quantiles_ms, settings_of, truth_of
from dpm2_core.console import progress_bar
from dpm2_core.estimates import State
from dpm2_core.evaluation.metrics import Metrics, evaluate
from dpm2_core.experiments.peers import at_stamps, cloud_and_times, end_of, kiss_icp_config
from dpm2_core.frame import Array, Frame
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.output import TrajectoryRecorder
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable, record_table

LENGTHS = (10.0, 20.0, 30.0, 40.0, 50.0)
"""Segments of the KITTI metric, m: the excerpts are too short for the benchmark's own lengths."""

OURS, NO_LOOPS, BASELINE = "dpm2", "dpm2 without loops", "kiss-icp"  # the last two do the same task

_ERRORS = ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m", "final_drift_percent", "t_err_percent", "r_err_deg_per_100m")


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of one method on one drive.

    Attributes:
        poses: (N, 4, 4) of the LiDAR; ours as written by `dpm2 run`, after optimization of the pose graph.
        seconds: (N,) wall time of each frame.
        cpu_seconds: of all frames and threads; less affected by other programs.
        stages: (N,) wall time of each stage, s.
        failed: number of frames without a registration.
        states: of each frame; empty if the method has none.
    """

    poses: Array
    seconds: Array
    cpu_seconds: float
    stages: dict[str, Array] = field(default_factory=dict)
    failed: int = 0
    states: list[State] = field(default_factory=list)


Method = Callable[[Sequence[Frame]], Trial]


def dpm2(options: Options, *more: str) -> Method:
    """This project's SLAM, including its mapper, with `more` settings."""
    settings = settings_of(options, *more)
    return lambda frames: mapped(settings, frames)[0]


def mapped(settings: SlamSettings, frames: Sequence[Frame]) -> tuple[Trial, Mapper]:
    """Process frames with the SLAM; returns the result and the map."""
    slam = make_slam(settings)
    tracked, recorder, seconds = [], TrajectoryRecorder(), np.zeros(len(frames))
    cpu = process_time()
    for i, frame in enumerate(frames):
        started = perf_counter()
        tracked.append(slam.process(frame).odometry)
        seconds[i] = perf_counter() - started
    cpu = process_time() - cpu
    stages = {stage: np.array([t.seconds[stage] for t in tracked]) for stage in tracked[0].seconds}
    failed = sum(not t.registration.ok for t in tracked)
    for t in tracked:
        recorder.add(t)
    states = [t.state for t in tracked]
    return Trial(recorder.poses(slam.mapper.poses), seconds, cpu, stages, failed, states), slam.mapper


def kiss_icp(options: Options) -> Method:
    """I. Vizzo et al., "KISS-ICP", RA-L 2023, run and timed as in its own pipeline. It de-skews where ours does: scans
    whose points have times, as in most bags. KITTI's scans are de-skewed already and have no times.

    Raises:
        MissingPackageError: it is not installed.
    """
    deskew_requested = settings_of(options).preprocess.deskew
    configs = {deskew: kiss_icp_config(options.threads, deskew) for deskew in (False, True)}
    from kiss_icp.kiss_icp import KissICP

    def run(frames: Sequence[Frame]) -> Trial:
        sweeps = [cloud_and_times(frame) for frame in frames]
        deskew = deskew_requested and any(frame.time_offset is not None for frame in frames)
        odometry = KissICP(configs[deskew])
        poses, seconds = np.zeros((len(frames), 4, 4)), np.zeros(len(frames))
        cpu = process_time()
        for i, (cloud, times) in enumerate(sweeps):
            started = perf_counter()
            odometry.register_frame(cloud, times if deskew else np.array([]))
            seconds[i] = perf_counter() - started
            poses[i] = odometry.last_pose
        cpu = process_time() - cpu
        if deskew:  # its poses are then those at the last points, the truth is at the stamps
            poses = at_stamps(poses, [end_of(frame) for frame in frames], [frame.stamp for frame in frames])
        return Trial(poses, seconds, cpu)

    return run


def bench_geometric(options: Options) -> Report:
    """Every method on every drive, `repetitions` times in turns; only processing is timed, scans are in memory.

    Raises:
        UsageError: there is no drive, or one has no ground truth.
    """
    methods = {OURS: dpm2(options), NO_LOOPS: dpm2(options, "slam.loops.enabled=false")}
    methods |= installed({BASELINE: partial(kiss_icp, options)})
    results: dict[str, Any] = {}
    truth: dict[str, str] = {}
    with drives(options) as sources, processors(options.threads), progress_bar() as progress:
        task = progress.add_task("benchmark", total=len(sources) * options.repetitions * len(methods))
        for drive, source in sources.items():
            poses, frames = truth_of(source), list(source.frames())
            trials: dict[str, list[Trial]] = {name: [] for name in methods}
            for _ in range(options.repetitions):
                for name, run in methods.items():
                    progress.update(task, description=f"{drive}: {name}")
                    trials[name].append(run(frames))
                    progress.advance(task)
            results[drive] = {method: summary(poses, trials[method]) for method in methods}
            truth[drive] = source.truth
            del frames
    notes = [] if BASELINE in methods else ["kiss-icp is not installed (pip install 'dpm2_ros[bench]'): no comparison."]
    for methods_of_drive in results.values():
        _add_ratios(methods_of_drive)
    shown = Group(view(results), *notes)
    return Report({"segment_lengths_m": LENGTHS, "truth": truth, "drives": results}, shown)


def summary(truth: Array, trials: Sequence[Trial]) -> dict[str, Any]:
    """Medians of errors and speed over the repetitions, and the spread of the speed."""
    metrics = [evaluate(truth, trial.poses, LENGTHS, failed_frames=trial.failed) for trial in trials]
    fps = np.array([len(trial.seconds) / trial.seconds.sum() for trial in trials])
    seconds = np.concatenate([trial.seconds for trial in trials])
    stages = {stage: np.concatenate([trial.stages[stage] for trial in trials]) for stage in trials[0].stages}
    return {
        **_median(metrics),
        "ape_rmse_m_of_thirds": _thirds(truth, trials[0].poses),
        "fps": float(np.median(fps)),
        "fps_of_repetitions": fps.round(4).tolist(),
        "cpu_ms": 1e3 * float(np.median([trial.cpu_seconds / len(trial.seconds) for trial in trials])),
        "frame_ms": quantiles_ms(seconds),
        "stages_ms": {stage: quantiles_ms(values) for stage, values in stages.items()},
    }


def _thirds(truth: Array, poses: Array) -> list[float | None]:
    """APE of each third of the drive by itself: distinguishes a steady error from a jump of estimate or truth."""
    edges = np.linspace(0, len(truth), 4).astype(int)
    return [evaluate(truth[a:b], poses[a:b]).ape_rmse_m if b - a > 1 else None for a, b in pairwise(edges.tolist())]


def _median(runs: Sequence[Metrics]) -> dict[str, Any]:
    """The median of each figure; multi-threaded sums may differ in the last digits between runs."""
    medians: dict[str, Any] = {name: getattr(runs[0], name) for name in ("frames", "path_length_m", "segments")}
    for name in ("failed_frames", *_ERRORS):
        values = [getattr(metrics, name) for metrics in runs]
        medians[name] = None if None in values else float(np.median(values))
    return medians


def _add_ratios(methods: dict[str, Any]) -> None:
    """Add the ratios of our figures to the baseline's; frame rates pairwise, since conditions vary over time."""
    if BASELINE not in methods:
        return
    baseline = methods[BASELINE]
    for name, row in ((OURS, "ratio"), (NO_LOOPS, "ratio without loops")):
        ours = methods[name]
        pairs = np.array(ours["fps_of_repetitions"]) / np.array(baseline["fps_of_repetitions"])
        ratios = {
            error: ours[error] / baseline[error] if ours[error] and baseline[error] else None for error in _ERRORS
        }
        ratios["cpu_ms"] = ours["cpu_ms"] / baseline["cpu_ms"]
        methods[row] = {**ratios, "fps": float(np.median(pairs))}


def view(results: dict[str, Any]) -> Group:
    """The tables: figures of all drives, and stages of each."""
    return Group(_table(results), *(_stages(name, result) for name, result in results.items()))


def _table(results: dict[str, Any]) -> FigureTable:
    figures = ("RPE m", "RPE deg", "APE m", "drift %", "t_err %", "Hz", "p95 ms", "CPU ms")
    title = "RPE: mean. APE: after SE(3) alignment. Drift: aligned at the start. t_err: KITTI metric."
    table = FigureTable(title, names=["drive", "method"], figures=figures)
    for drive, methods in results.items():
        for method, row in methods.items():
            errors = ["-" if row[name] is None else f"{row[name]:.3f}" for name in _ERRORS[:5]]
            if method.startswith("ratio"):
                speed = [f"{row['fps']:.2f}", "", f"{row['cpu_ms']:.2f}"]
            else:
                speed = [f"{row['fps']:.1f}", f"{row['frame_ms']['p95']:.0f}", f"{row['cpu_ms']:.0f}"]
            table.add_row(drive, method, *errors, *speed)
        table.add_section()
    return table


def _stages(drive: str, methods: dict[str, Any]) -> FigureTable:
    columns = {"median": "{median:.1f}", "p95": "{p95:.1f}"}
    return record_table(f"Stages of {OURS} on {drive}, ms", ["stage"], columns, methods[OURS]["stages_ms"])
