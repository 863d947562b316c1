# SPDX-License-Identifier: Apache-2.0
"""Effect of our deviations from DeepPointMap2's SLAM: each of its methods put into ours, and all of them together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.geometric import mapped
from benchmarks.harness import Options, Report, drives, processors, requested, settings_of, truth_of
from benchmarks.loops import check_loops
from dpm2_core.console import progress_bar
from dpm2_core.data.trajectory import arc_lengths
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.frame import Array, Frame
from dpm2_core.sim.simulated_drive import SimulatedDrive
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable, record_table

_OURS = ("slam.registration=neural", "slam.visual.enabled=false")
_NEAREST = ("slam.neural.spacing=10", "slam.neural.residual=2.5", "slam.neural.frames=1")
WAYS: dict[str, Sequence[str]] = {
    "ours": _OURS,
    "start: most confident pairs": (*_OURS, "slam.neural.solver=confident"),
    "nearest keyframe": (*_OURS, *_NEAREST),
    "nearest keyframe, then scan to map": (*_OURS, *_NEAREST, "slam.neural.refined=16"),
    "keyframes by residual": (
        *_OURS, "slam.keyframes.distance=10", "slam.keyframes.residual=2.5", "slam.keyframes.angle=180",
    ),
    "loops by the overlap head": (
        *_OURS, "slam.loops.decided_by=overlap", "slam.loops.min_overlap=0.7", "slam.loops.candidates=16",
        "slam.loops.verified=1", "slam.pose_graph.loop_kernel=1e9", "slam.pose_graph.loop_sigmas=1e9",
        "slam.pose_graph.odometry_sigmas=1e9",
    ),
    "the paper's": ("slam.preset=paper",),
}  # fmt: skip
_ERRORS = ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m", "final_drift_percent")
_LAPS = 1.35
"""Laps driven in the synthetic suburb: the last third revisits earlier places..."""
_EVERY = 2
"""...with this many steps of 0.5 m between two scans."""


def bench_paper(options: Options) -> Report:
    """Every variant on every drive, once, with the network alone and without images; `--only` chooses one variant.

    Raises:
        UsageError: there is no drive, or one has no ground truth.
    """
    results: dict[str, Any] = {}
    more = [] if options.sources else [lap()]
    with drives(options, more) as sources, processors(options.threads), progress_bar() as progress:
        for name, source in sources.items():
            frames = list(source.frames())
            truth, results[name] = truth_of(source), {}
            for variant in progress.track(requested(options, WAYS), description=name):
                results[name][variant] = _evaluate_drive(settings_of(options, *WAYS[variant]), frames, truth)
    return Report({"settings": WAYS, "drives": results}, _table(results))


def lap() -> SimulatedDrive:
    """A drive around a block, continuing into the street where it began."""
    drive = SimulatedDrive("loop", "suburb", 950_000, "suburb")
    travelled = arc_lengths(drive.poses[:, :3, 3])
    distance_to_start = np.linalg.norm(drive.poses[:, :3, 3] - drive.poses[0, :3, 3], axis=1)
    end = int(np.searchsorted(travelled, _LAPS * travelled[(travelled > 50) & (distance_to_start < 10)][0]))
    drive.times, drive.poses = drive.times[:end:_EVERY], drive.poses[:end:_EVERY]
    return drive


def _evaluate_drive(settings: SlamSettings, frames: Sequence[Frame], truth: Array) -> dict[str, Any]:
    trial, mapper = mapped(settings, frames)
    metrics = evaluate(truth, trial.poses, failed_frames=trial.failed)
    rows = {frame.index: row for row, frame in enumerate(frames)}  # an excerpt need not begin with scan 0
    loops = check_loops(mapper.loops, truth[[rows[keyframe.index] for keyframe in mapper.keyframes]])
    return {
        "frames": len(frames), "failed_frames": trial.failed, "keyframes": len(mapper.keyframes),
        **{name: getattr(metrics, name) for name in _ERRORS},
        "loops": {name: loops[name] for name in ("tried", "accepted", "wrong", "error_m")},
    }  # fmt: skip


def _table(results: dict[str, Any]) -> FigureTable:
    columns = {
        "RPE m": "{rpe_trans_m:.3f}", "RPE deg": "{rpe_rot_deg:.3f}", "ATE m": "{ape_rmse_m:.3f}",
        "drift %": "{final_drift_percent:.3f}", "failed": "{failed_frames}", "keyframes": "{keyframes}",
        "loops": "{loops[accepted]}", "wrong": "{loops[wrong]}",
    }  # fmt: skip
    return record_table("The paper's methods, each in place of ours", ["drive", "method"], columns, results)
