# SPDX-License-Identifier: Apache-2.0
"""Pose graphs with wrong loops: loops kept, quality of the poses, solving time, and effect on a running odometry."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from rich.console import Group
from scipy.spatial import cKDTree

from benchmarks.harness import Options, Report, excerpt
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.g2o import read_g2o
from dpm2_core.slam.graph.graph_data import GraphData, integrate
from dpm2_core.slam.graph.robust import RobustSettings, least_squares, optimize
from dpm2_core.slam.graph.worker import GraphWorker
from dpm2_core.tables import FigureTable, record_table

_ODOMETRY_SIGMAS = np.array([4e-4, 4e-4, 2e-3, 0.02, 0.02, 0.02])  # rad, m: noise of the generated drive's odometry
_LOOP_SIGMAS = np.array([5e-3, 5e-3, 5e-3, 0.05, 0.05, 0.05])
_MAX_LOOP_ERROR = (5.0, np.radians(5.0))  # m, rad: a loop with a larger error is wrong
_FRAMES = 150  # of the processing loop that a solver disturbs
_WRONG_LOOP_COUNTS = (60, 120, 200, 300)
_Mask = NDArray[np.bool_]


def bench_pose_graph(options: Options) -> Report:
    """KITTI 00 with detected loops at three thresholds, and a generated drive of 5,000 poses with injected wrong loops.

    Raises:
        UsageError: there are no KITTI pose graphs.
    """
    folder = excerpt() / "pose_graphs"
    if not (folder / "kitti_00_GT.g2o").is_file():
        raise UsageError(f"{folder}: no kitti_00_GT.g2o; set DPM2_KITTI to the KITTI excerpt")
    truth = read_g2o(folder / "kitti_00_GT.g2o").graph.poses
    kitti = {}
    for alpha in ("0.00", "0.30", "0.60"):
        graph = read_g2o(folder / f"kitti_00_alpha_{alpha}.g2o").graph
        kitti[alpha] = _row(truth, graph, are_right(truth, graph), options.repetitions) | _gtsam_alone(truth, graph)
    injected = {}
    truth, clean = made_drive(0)
    reference = _row(truth, clean, are_right(truth, clean), 1)["ate_m"]
    for wrong in _WRONG_LOOP_COUNTS:
        truth, graph = made_drive(wrong)
        row = _row(truth, graph, are_right(truth, graph), options.repetitions)
        injected[str(wrong)] = row | {"ate_over_clean": row["ate_m"] / reference}
    odometry = disturbance(graph)
    results = {"kitti_00": kitti, "injected": {"clean_ate_m": reference, **injected}, "odometry": odometry}
    return Report(results, Group(_table("KITTI 00, alpha", kitti), _table("5,000 poses, wrong loops", injected)))


def are_right(truth: Array, graph: GraphData) -> _Mask:
    """(E,) whether each loop is within 5 m and 5 degrees of the true poses."""
    a, b = graph.ends.T
    errors = se3.inverse(graph.T_from_to) @ se3.inverse(truth[a]) @ truth[b]
    return np.asarray(
        (np.linalg.norm(errors[:, :3, 3], axis=1) < _MAX_LOOP_ERROR[0]) & (se3.angle(errors) < _MAX_LOOP_ERROR[1])
    )


def made_drive(wrong: int, count: int = 5000, right: int = 200) -> tuple[Array, GraphData]:
    """True poses of a drive that revisits its path, and its graph with noise according to its covariances.

    Wrong loops connect positions more than 20 m apart, as look-alike places do.
    """
    rng = np.random.default_rng(0)
    u = 2 * np.pi * np.arange(count) / 1250
    positions = np.stack(
        [250 * np.sin(u) + 60 * np.sin(2 * u), 200 * np.sin(2 * u + 0.3) + 30 * np.cos(u), 5 * np.sin(u)], 1
    )
    direction = np.gradient(positions, axis=0)
    headings = np.zeros((count, 6))
    headings[:, 2] = np.arctan2(direction[:, 1], direction[:, 0])
    truth = se3.make(se3.exp(headings)[:, :3, :3], positions)
    steps = np.tile(np.eye(4), (count, 1, 1))
    steps[1:] = se3.inverse(truth[:-1]) @ truth[1:] @ se3.exp(rng.normal(size=(count - 1, 6)) * _ODOMETRY_SIGMAS)
    covariances = np.tile(np.diag(_ODOMETRY_SIGMAS**2), (count, 1, 1))
    covariances[0] = 0
    near = np.array(sorted(cKDTree(positions).query_pairs(6.0)))
    near = near[near[:, 1] - near[:, 0] > 200]
    ends = near[rng.choice(len(near), right, replace=False)]
    a, b = ends.T
    T = se3.inverse(truth[a]) @ truth[b] @ se3.exp(rng.normal(size=(right, 6)) * _LOOP_SIGMAS)
    pairs = np.sort(rng.integers(0, count, (20 * wrong + 1, 2)), axis=1)
    distance = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    wrong_pairs = pairs[(distance > 20) & (pairs[:, 1] - pairs[:, 0] > 200)][:wrong]
    wrong_motions = np.zeros((len(wrong_pairs), 6))
    wrong_motions[:, 2] = rng.uniform(-np.pi, np.pi, len(wrong_pairs))
    wrong_motions[:, 3:] = rng.uniform(-2, 2, (len(wrong_pairs), 3))
    ends, T = np.concatenate([ends, wrong_pairs]), np.concatenate([T, se3.exp(wrong_motions)])
    loop_covariances = np.tile(np.diag(_LOOP_SIGMAS**2), (len(ends), 1, 1))
    graph = GraphData(truth.copy(), np.arange(count) > 0, steps, covariances, ends, T, loop_covariances)
    return truth, replace(graph, poses=integrate(graph))


def disturbance(graph: GraphData) -> dict[str, Any]:
    """p95 of a 10 Hz loop with 30 ms of work, alone and while a process solves the graph repeatedly."""
    work = np.random.default_rng(0).normal(size=(40_000, 3))

    def loop(worker: GraphWorker | None) -> tuple[list[float], int]:
        durations, solved = [], 0
        for _ in range(_FRAMES):
            if worker is not None:
                solved += worker.take() is not None
                if not worker.busy:
                    worker.submit(graph, RobustSettings())
            began = time.perf_counter()
            cKDTree(work).query(work[:8000])
            durations.append(time.perf_counter() - began)
            time.sleep(max(0.0, 0.1 - durations[-1]))
        return durations, solved

    loop(None)  # warm-up
    alone, _ = loop(None)
    worker = GraphWorker()
    try:
        worker.submit(graph, RobustSettings())
        worker.take(wait=True)
        with_solver, solved = loop(worker)
    finally:
        worker.close()
    p95 = [float(np.percentile(durations, 95)) for durations in (alone, with_solver)]
    return {"p95_alone_s": p95[0], "p95_beside_solver_s": p95[1], "ratio": p95[1] / p95[0], "solved": solved}


def _row(truth: Array, graph: GraphData, right: _Mask, repetitions: int) -> dict[str, Any]:
    seconds = []
    for _ in range(repetitions):
        began = time.perf_counter()
        result = optimize(graph, RobustSettings())
        poses = least_squares(replace(graph, poses=result.poses), result.kept)
        seconds.append(time.perf_counter() - began)
    return {
        "loops": len(right),
        "right": int(right.sum()),
        "right_kept": int((result.kept & right).sum()),
        "wrong_kept": int((result.kept & ~right).sum()),
        "odometry_ate_m": ape_rmse(truth, integrate(graph)),
        "ate_m": ape_rmse(truth, poses),
        "seconds": min(seconds),
        "rounds": result.rounds,
    }


def _gtsam_alone(truth: Array, graph: GraphData) -> dict[str, Any]:
    """gtsam alone on the whole graph: least squares, the Cauchy kernel, and graduated non-convexity."""
    nodes = np.flatnonzero(graph.chained)
    odometry = [(int(n) - 1, int(n), graph.steps[n], graph.step_covariances[n]) for n in nodes]
    loops = [
        (int(a), int(b), T, C) for (a, b), T, C in zip(graph.ends, graph.T_from_to, graph.covariances, strict=True)
    ]

    def solve(kernel: float | None, gnc: bool = False) -> Array:
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for node, pose in enumerate(graph.poses):
            values.insert(node, gtsam.Pose3(pose))
        factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(graph.poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
        for k, (a, b, T, C) in enumerate(odometry + loops):
            noise: Any = gtsam.noiseModel.Gaussian.Covariance(C)
            if kernel is not None and k >= len(odometry):
                noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(kernel), noise)
            factors.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T), noise))
        if gnc:
            parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
            parameters.setKnownInliers(list(range(len(odometry) + 1)))
            solved = gtsam.GncLMOptimizer(factors, values, parameters).optimize()
        else:
            solved = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
        return np.array([solved.atPose3(node).matrix() for node in range(len(graph))])

    methods: dict[str, Callable[[], Array]] = {
        "least_squares": lambda: solve(None),
        "cauchy": lambda: solve(5.0),
        "gnc": lambda: solve(None, gnc=True),
    }
    out: dict[str, Any] = {}
    for name, method in methods.items():
        began = time.perf_counter()
        poses = method()
        out[name] = {"ate_m": ape_rmse(truth, poses), "seconds": time.perf_counter() - began}
    return out


def _table(title: str, rows: dict[str, Any]) -> FigureTable:
    columns = {
        "loops": "{loops}", "right kept": "{right_kept} of {right}", "wrong kept": "{wrong_kept}",
        "odometry ATE, m": "{odometry_ate_m:.2f}", "ATE, m": "{ate_m:.3f}", "s": "{seconds:.2f}",
    }  # fmt: skip
    return record_table(title, [""], columns, rows)
