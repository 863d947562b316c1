# SPDX-License-Identifier: Apache-2.0
"""Robust least squares on a graph whose covariances may be wrong by a common factor, as in many g2o files.

The distance of loops from the odometry between their ends shows how large the covariances should be, before anything is
solved. Right loops are the near ones, so a low quantile shows it even if most loops are wrong. Loops that are far off
by that measure are set aside at first. chi2 per degree of freedom of those that agree then refines the factor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from dpm2_core.frame import Array
from dpm2_core.slam.graph.graph_data import GraphData, chain_chi2, integrate, loop_errors, mahalanobis, total_chi2
from dpm2_core.slam.graph.robust import RobustSettings, Solution, optimize

_SETTINGS = RobustSettings(odometry_sigmas=5.0)  # tighter than by default, where the covariances are used as given
_SOLVER_STEPS = 10  # reveal most wrong loops; converging to an optimum with them takes minutes
_QUANTILE, _QUANTILE_OF_RIGHT = 0.2, 0.3  # quantile of all loops, and among the right ones if a third is wrong
_MIN_LOOPS = 8  # fewer do not show how large the covariances are
_MIN_NODES_APART = 10  # nodes; loops between nearer ones often repeat the odometry
_CHI2_FACTOR = 2.0  # on chi2 per degree of freedom of the loops that passed, which lacks the distribution's tail
_RETRIED_RATIO = 0.05  # of rejected loops that are tried again to kept ones; few, as each may slow the solver
_MAX_STAGES = 6
_MAX_SCALE = 4.0  # a larger factor means that the covariances are too small, unless most loops are wrong
_MIN_LOOP_SHARE = 0.35  # of chi2 in the loops; about half where they check each other


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The result of a calibrated optimization.

    Attributes:
        solution: its sigmas are those of the covariances times `scale`.
        scale: factor on all covariances with which the loops were judged; 1 if too few loops show it.
        undecided: the odometry is too uncertain to distinguish wrong loops from right ones, and there are too few loops
            to check each other.
    """

    solution: Solution
    scale: float
    undecided: bool


def scaled(graph: GraphData, factor: float) -> GraphData:
    """The graph with all covariances times a factor; the least-squares optimum is the same."""
    return replace(graph, covariances=graph.covariances * factor, step_covariances=graph.step_covariances * factor)


def chi2_per_dof(graph: GraphData, poses: Array, kept: NDArray[np.bool_], dof: int) -> float:
    """chi2 over odometry and kept loops, per degree of freedom (`dof` per kept loop); nan without a loop."""
    count = int(kept.sum())
    return total_chi2(graph, poses, kept) / (dof * count) if count else float("nan")


def optimize_calibrated(graph: GraphData, dof: int, report: Callable[[str], None] = lambda _: None) -> Calibrated:
    """Optimize and check the loops with covariances that fit them; deterministic.

    Args:
        dof: degrees of freedom of an edge: 3 of SE2, 6 of SE3.
        report: called with a text for each stage.

    Raises:
        Dpm2Error: the system is singular.
    """
    odometry = integrate(graph)
    chain_scale = _chain_scale(graph, odometry, dof)
    accepts_wrong, solution, scale = False, None, 1.0
    if chain_scale is not None:
        accepts_wrong = _accepts_wrong_loops(graph, odometry, chain_scale)
        solution, scale = _optimize_in_stages(graph, dof, chain_scale, report)
        if accepts_wrong and chain_scale > _MAX_SCALE and not _most_loops_agree(graph, solution, scale / chain_scale):
            solution = None  # with such large covariances any loop passes: perhaps all are wrong
    if solution is None:
        solution, scale = optimize(graph, RobustSettings()), 1.0
        accepts_wrong = bool(solution.kept.any()) and _accepts_wrong_loops(graph, odometry, scale)
    return Calibrated(solution, scale, accepts_wrong and _loop_share(graph, solution) < _MIN_LOOP_SHARE)


def _most_loops_agree(graph: GraphData, solution: Solution, growth: float) -> bool:
    """Whether most loops are kept, more than one per place, with covariances that have not grown much beyond those that
    the odometry suggests: wrong loops alone do not achieve that."""
    majority = solution.kept.sum() > max(len(np.unique(graph.ends)), len(graph.ends) / 2)
    return bool(growth < _MAX_SCALE and majority)


def _optimize_in_stages(
    graph: GraphData, dof: int, chain_scale: float, report: Callable[[str], None]
) -> tuple[Solution, float]:
    scale, poses, used = chain_scale, graph.poses, None
    # Wrong loops that were kept would let in others.
    max_scale = np.inf if chain_scale > _MAX_SCALE else max(chain_scale, 1.0)
    for stage in range(_MAX_STAGES):
        report(f"stage {stage + 1}: covariances times {scale:.3g}")
        solution = optimize(scaled(replace(graph, poses=poses), scale), _SETTINGS, used, _SOLVER_STEPS)
        new_scale = min(max_scale, _CHI2_FACTOR * chi2_per_dof(graph, solution.poses, solution.kept, dof))
        if not 0 < new_scale < np.inf or (stage and 0.5 < new_scale / scale < 1.25) or stage == _MAX_STAGES - 1:
            break
        last = min(len(solution.sigmas) - 1, int((1 + _RETRIED_RATIO) * solution.kept.sum()))
        scale, poses, used = new_scale, solution.poses, solution.sigmas <= np.sort(solution.sigmas)[last]
    return solution, scale


def _chain_scale(graph: GraphData, odometry: Array, dof: int) -> float | None:
    """Factor on all covariances with which the right loops agree with the odometry; None with too few loops."""
    far = np.abs(graph.ends[:, 1] - graph.ends[:, 0]) > _MIN_NODES_APART
    chi2 = chain_chi2(graph, odometry)[far]
    chi2 = chi2[np.isfinite(chi2)]
    if len(chi2) < _MIN_LOOPS:
        return None
    factor = float(np.quantile(chi2, _QUANTILE) / chdtri(dof, 1 - _QUANTILE_OF_RIGHT))
    return factor if factor > 0 else None  # without noise there is nothing to calibrate


def _accepts_wrong_loops(graph: GraphData, odometry: Array, factor: float) -> bool:
    """Whether the odometry would accept most loops with one end moved by half of the graph."""
    wrong_ends = np.stack([graph.ends[:, 0], (graph.ends[:, 1] + len(graph) // 2) % len(graph)], -1)
    sigmas = np.sqrt(chain_chi2(scaled(replace(graph, ends=wrong_ends), factor), odometry))
    return bool((sigmas < _SETTINGS.odometry_sigmas).mean() > 0.5)


def _loop_share(graph: GraphData, solution: Solution) -> float:
    """Fraction of chi2 in the loops: if they do not check each other, nearly all of it is in the odometry."""
    kept = solution.kept
    errors = loop_errors(solution.poses, graph.ends[kept], graph.T_from_to[kept])
    total = total_chi2(graph, solution.poses, kept)
    return float(mahalanobis(errors, graph.covariances[kept]).sum() / total) if total else 0.0
