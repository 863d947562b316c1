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
_STEPS = 10  # solver steps that reveal most wrong loops; converging to an optimum with them takes minutes
_QUANTILE, _AMONG_RIGHT = 0.2, 0.3  # quantile of all loops, and among the right ones if a third is wrong
_LEAST = 8  # loops; fewer do not show how large the covariances are
_APART = 10  # nodes; loops between nearer ones often repeat the odometry
_ROOM = 2.0  # factor on chi2 per degree of freedom of the loops that passed, which lacks the tail of its distribution
_AGAIN = 0.05  # rejected loops that are tried again, as a fraction of the kept ones; few, as each may slow the solver
_STAGES = 6
_TOO_FIRM = 4.0  # a larger factor means that the covariances are too small, unless most loops are wrong
_SHARE = 0.35  # of chi2 in the loops; about half where they check each other


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
    first = _chain_scale(graph, odometry, dof)
    loose, solution, scale = False, None, 1.0
    if first is not None:
        loose = _others_pass(graph, odometry, first)
        solution, scale = _stages(graph, dof, first, report)
        if loose and first > _TOO_FIRM and not _agree(graph, solution, scale / first):
            solution = None  # with such large covariances any loop passes: perhaps all are wrong
    if solution is None:
        solution, scale = optimize(graph, RobustSettings()), 1.0
        loose = bool(solution.kept.any()) and _others_pass(graph, odometry, scale)
    return Calibrated(solution, scale, loose and _loop_share(graph, solution) < _SHARE)


def _agree(graph: GraphData, solution: Solution, grown: float) -> bool:
    """Whether most loops are kept, more than one per place, with covariances that have not grown much beyond those that
    the odometry suggests: wrong loops alone do not achieve that."""
    most = solution.kept.sum() > max(len(np.unique(graph.ends)), len(graph.ends) / 2)
    return bool(grown < _TOO_FIRM and most)


def _stages(graph: GraphData, dof: int, first: float, report: Callable[[str], None]) -> tuple[Solution, float]:
    scale, poses, used = first, graph.poses, None
    most = np.inf if first > _TOO_FIRM else max(first, 1.0)  # wrong loops that were kept would let in others
    for stage in range(_STAGES):
        report(f"stage {stage + 1}: covariances times {scale:.3g}")
        solution = optimize(scaled(replace(graph, poses=poses), scale), _SETTINGS, used, _STEPS)
        fitting = min(most, _ROOM * chi2_per_dof(graph, solution.poses, solution.kept, dof))
        if not 0 < fitting < np.inf or (stage and 0.5 < fitting / scale < 1.25) or stage == _STAGES - 1:
            break
        near = min(len(solution.sigmas) - 1, int((1 + _AGAIN) * solution.kept.sum()))
        scale, poses, used = fitting, solution.poses, solution.sigmas <= np.sort(solution.sigmas)[near]
    return solution, scale


def _chain_scale(graph: GraphData, odometry: Array, dof: int) -> float | None:
    """Factor on all covariances with which the right loops agree with the odometry; None with too few loops."""
    far = np.abs(graph.ends[:, 1] - graph.ends[:, 0]) > _APART
    apart = chain_chi2(graph, odometry)[far]
    apart = apart[np.isfinite(apart)]
    if len(apart) < _LEAST:
        return None
    factor = float(np.quantile(apart, _QUANTILE) / chdtri(dof, 1 - _AMONG_RIGHT))
    return factor if factor > 0 else None  # without noise there is nothing to calibrate


def _others_pass(graph: GraphData, odometry: Array, factor: float) -> bool:
    """Whether the odometry would accept most loops with one end moved by half of the graph."""
    other = np.stack([graph.ends[:, 0], (graph.ends[:, 1] + len(graph) // 2) % len(graph)], -1)
    apart = np.sqrt(chain_chi2(scaled(replace(graph, ends=other), factor), odometry))
    return bool((apart < _SETTINGS.odometry_sigmas).mean() > 0.5)


def _loop_share(graph: GraphData, solution: Solution) -> float:
    """Fraction of chi2 in the loops: if they do not check each other, nearly all of it is in the odometry."""
    kept = solution.kept
    errors = loop_errors(solution.poses, graph.ends[kept], graph.T_from_to[kept])
    total = total_chi2(graph, solution.poses, kept)
    return float(mahalanobis(errors, graph.covariances[kept]).sum() / total) if total else 0.0
