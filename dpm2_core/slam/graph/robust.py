# SPDX-License-Identifier: Apache-2.0
"""Robust least squares on a pose graph: the poses, and for each loop whether it can be right.

The odometry is trusted within its covariances, loops are not. A loop that clearly contradicts the odometry between its
ends is set aside at first. The others are optimized with a Cauchy kernel, which reduces the weight of large errors.
Every loop, also those set aside, is then checked by its distance from the optimized poses. This repeats until the
results no longer change. Only the nodes at the ends of loops are unknowns: the odometry between them is compounded, and
the inner nodes follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.graph_data import (
    CondensedOdometry,
    GraphData,
    Index,
    chain_chi2,
    components,
    integrate,
    loop_errors,
    mahalanobis,
    trajectories,
)

_FIX_KERNEL = 1.0  # as `loop_kernel`: many consecutive fixes may have the same error; none may outvote the odometry
_MIN_LOOP_DENSITY = 0.6
"""Loops per end node, above which a linear start is tried: at 0.5 no two loops share a node, and wrong ones may
dominate where all are solved at once."""
_MAX_ERROR_RATIO = 5.0  # of its error to that of the given poses, which the kernel limits; 13 with wrong loops
_MAX_ROUNDS = 8  # of solving and checking
_MAX_STEPS = 50  # Levenberg-Marquardt steps per round
_FIXED_SIGMA = 1e-6  # rad and m, standard deviation of a fixed pose


class RobustSettings(Settings):
    """How loops are weighted and checked."""

    loop_kernel: float = Field(5.0, gt=0)
    """Width of the Cauchy kernel on loop edges, in standard deviations: loops much farther off hardly count."""
    loop_sigmas: float = Field(10.0, gt=0)
    """A loop is accepted if the optimized poses are within this many standard deviations of it. Right loops are within
    5, wrong ones hundreds off: the margin is for covariances that are too small."""
    odometry_sigmas: float = Field(20.0, gt=0)
    """A loop is set aside at first if the odometry between its ends is more than this many standard deviations off."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The result of an optimization.

    Attributes:
        poses: (N, 4, 4) optimized.
        kept: (E,) whether each loop was used.
        sigmas: (E,) distance of the optimized poses from each loop, in standard deviations.
        odometry_sigmas: (E,) the same for the odometry alone; nan for loops between two trajectories.
        rounds: of solving and checking.
        settled: whether the results no longer changed; else they are those of the last allowed round.
    """

    poses: Array
    kept: NDArray[np.bool_]
    sigmas: Array
    odometry_sigmas: Array
    rounds: int = 0
    settled: bool = True

    def reason(self, loop: int) -> str:
        """Why a loop was kept or rejected, in words."""
        info = f"{self.sigmas[loop]:.1f} sigma from the optimized poses"
        if np.isfinite(self.odometry_sigmas[loop]):
            info += f", {self.odometry_sigmas[loop]:.1f} from the odometry"
        return info


@contextmanager
def _solvable() -> Iterator[None]:
    """Raise Dpm2Error if the system is singular, for example because a covariance is not positive definite."""
    try:
        yield
    except (RuntimeError, np.linalg.LinAlgError) as error:  # gtsam's or numpy's
        raise Dpm2Error(f"pose graph: {' '.join(str(error).split())}") from None


@_solvable()
def optimize(
    graph: GraphData, settings: RobustSettings, used: NDArray[np.bool_] | None = None, steps: int = _MAX_STEPS
) -> Solution:
    """Optimize and check the loops; deterministic.

    Args:
        used: (E,) loops to start with, from poses that agree with them; default: those that the odometry does not
            contradict.
        steps: maximum number of solver steps in each round of solving and checking.

    Raises:
        Dpm2Error: the system is singular.
    """
    odometry = integrate(graph)
    chain_sigmas = np.sqrt(chain_chi2(graph, odometry))
    linear_first = used is None and len(graph.ends) > _MIN_LOOP_DENSITY * len(np.unique(graph.ends))
    if used is None:
        used = ~(chain_sigmas > settings.odometry_sigmas)
    aligned = _align_trajectories(graph, graph.poses, used, settings.loop_kernel)
    condensed = CondensedOdometry(graph, odometry, np.concatenate([graph.ends.ravel(), graph.fixed]))
    ends = np.searchsorted(condensed.nodes, graph.ends)
    poses = aligned[condensed.nodes]
    settled, count = False, 0
    while not settled and count < _MAX_ROUNDS:
        count += 1
        factors = _factors(graph, condensed, ends, poses, used, settings.loop_kernel)
        starts = [poses]
        if linear_first and count == 1:
            starts += _linear_start(factors, poses, next(_anchors(graph, condensed, ends[used])))
        poses = _solve(factors, starts, steps)
        sigmas = np.sqrt(mahalanobis(loop_errors(poses, ends, graph.T_from_to), graph.covariances))
        kept = sigmas <= settings.loop_sigmas
        settled = bool((kept == used).all())
        if not settled and count < _MAX_ROUNDS:
            used = kept
    return Solution(condensed.spread(poses), used, sigmas, chain_sigmas, count, settled)


@_solvable()
def least_squares(graph: GraphData, kept: NDArray[np.bool_]) -> Array:
    """(N, 4, 4) the plain least-squares optimum over the odometry and the kept loops, every node an unknown.

    Raises:
        Dpm2Error: the system is singular.
    """
    condensed = CondensedOdometry(graph, integrate(graph), np.arange(len(graph)))
    return _solve(_factors(graph, condensed, graph.ends, graph.poses, kept, None), [graph.poses], _MAX_STEPS)


def joint_covariance(graph: GraphData, kept: NDArray[np.bool_], nodes: Index) -> Array:
    """(6 n, 6 n) covariance of distinct nodes' optimized poses, [rotation, translation] of T_map_node @ Exp(xi) each in
    turn; `kept`: (E,) loops to use."""
    ends = graph.ends[kept].ravel()
    condensed = CondensedOdometry(graph, integrate(graph), np.concatenate([ends, graph.fixed, nodes]))
    ends = np.searchsorted(condensed.nodes, graph.ends)  # wrong for loops that are not kept; these are not read
    poses = graph.poses[condensed.nodes]
    marginals = gtsam.Marginals(_factors(graph, condensed, ends, poses, kept, None), _values(poses))
    keys = np.searchsorted(condensed.nodes, nodes)
    if len(keys) == 1:
        return np.asarray(marginals.marginalCovariance(int(keys[0])))
    joint = marginals.jointMarginalCovariance([int(key) for key in keys])
    return np.block([[joint.at(int(a), int(b)) for b in keys] for a in keys])


def _factors(
    graph: GraphData,
    condensed: CondensedOdometry,
    ends: Index,
    poses: Array,
    used: NDArray[np.bool_],
    kernel: float | None,
) -> Any:
    """The gtsam graph of the chosen nodes; `ends` are indices among them; without a kernel: plain least squares."""
    factors, gaussian = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Gaussian.Covariance
    noise: gtsam.noiseModel.Base
    covariances = graph.constraint_covariances
    by_satellite = np.asarray(np.isin(ends, np.searchsorted(condensed.nodes, graph.enu)).any(axis=1))
    for k in np.flatnonzero(condensed.chained):
        noise = gaussian(condensed.covariances[k])
        factors.add(gtsam.BetweenFactorPose3(int(k) - 1, int(k), gtsam.Pose3(condensed.T[k]), noise))
    for loop in np.flatnonzero(used):
        noise = gaussian(covariances[loop])
        if kernel is not None:
            width = _FIX_KERNEL if by_satellite[loop] else kernel
            width /= 1.0 if graph.inflation is None else float(np.sqrt(graph.inflation[loop]))
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(width), noise)
        a, b = ends[loop].tolist()
        factors.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(graph.T_from_to[loop]), noise))
    fixed_noise = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    for anchor in _anchors(graph, condensed, ends[used]):
        factors.add(gtsam.PriorFactorPose3(anchor, gtsam.Pose3(poses[anchor]), fixed_noise))
    return factors


def _anchors(graph: GraphData, condensed: CondensedOdometry, ends: Index) -> Iterator[int]:
    """The fixed nodes, and one node in each part of the graph without any."""
    chained = np.flatnonzero(condensed.chained)
    part = components(len(condensed.nodes), np.concatenate([np.stack([chained - 1, chained], -1), ends]))
    fixed = np.searchsorted(condensed.nodes, graph.fixed)
    yield from np.unique(fixed).tolist()
    first = np.unique(part, return_index=True)[1]
    yield from first[~np.isin(part[first], part[fixed])].tolist()


def _values(poses: Array) -> Any:
    values = gtsam.Values()
    for node, pose in enumerate(poses):
        values.insert(node, gtsam.Pose3(pose))
    return values


def _linear_start(factors: Any, poses: Array, anchor: int) -> list[Array]:
    """The poses (N, 4, 4) from a linear problem for all rotations at once; none if their error is far larger.

    From far away a solver may converge to a local optimum that contains whole rotations and contradicts right loops. L.
    Carlone et al., "Initialization techniques for 3D SLAM", ICRA 2015 (chordal relaxation).
    """
    try:
        linear = _to_array(gtsam.InitializePose3.initialize(factors), len(poses))
    except RuntimeError:  # a singular system
        return []
    linear = se3.orthonormalized(poses[anchor] @ se3.inverse(linear[anchor]) @ linear)
    return [linear] if factors.error(_values(linear)) < _MAX_ERROR_RATIO * factors.error(_values(poses)) else []


def _solve(factors: Any, starts: Sequence[Array], steps: int) -> Array:
    """The best solution of those from the starts (N, 4, 4)."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(steps)
    solvers = [gtsam.LevenbergMarquardtOptimizer(factors, _values(start), parameters) for start in starts]
    solved = [solver.optimize() for solver in solvers]
    return _to_array(min(solved, key=factors.error), len(starts[0]))


def _to_array(values: Any, count: int) -> Array:
    return np.array([values.atPose3(node).matrix() for node in range(count)])


def _align_trajectories(graph: GraphData, poses: Array, used: NDArray[np.bool_], kernel: float) -> Array:
    """The poses, with each trajectory moved rigidly to where most of its loops to those placed before agree.

    Otherwise a trajectory whose own frame is far away or rotated would need many small steps. Trajectories are placed
    from fixed nodes on, each time the one with most loops to those that are placed.
    """
    trajectory = trajectories(graph)
    if trajectory[-1] == 0:
        return poses
    poses, loop_trajectories = poses.copy(), trajectory[graph.ends]
    used = (
        used
        & ~np.isin(loop_trajectories, trajectory[graph.enu]).any(1)
        & (loop_trajectories[:, 0] != loop_trajectories[:, 1])
    )
    placed = np.isin(np.arange(trajectory[-1] + 1), trajectory[graph.fixed])
    while not placed.all():
        new = used & (placed[loop_trajectories].sum(1) == 1)
        if not new.any():  # another part of the graph begins
            placed[np.argmin(placed)] = True
            continue
        ends = loop_trajectories[new]
        moving = int(np.bincount(ends[~placed[ends]]).argmax())
        loops = np.flatnonzero(new & (loop_trajectories == moving).any(1))
        poses[trajectory == moving] = (
            _best_move(graph, poses, loops, loop_trajectories[loops, 0] == moving, kernel) @ poses[trajectory == moving]
        )
        placed[moving] = True
    return poses


def _best_move(
    graph: GraphData, poses: Array, loops: NDArray[np.intp], swap: NDArray[np.bool_], kernel: float
) -> Array:
    """(4, 4) that moves a trajectory to where most of its loops (indices) agree; `swap`: loops that start in it."""
    ends, T = graph.ends[loops], graph.T_from_to[loops]
    before, after = np.where(swap, ends[:, 1], ends[:, 0]), np.where(swap, ends[:, 0], ends[:, 1])
    T_before_after = np.where(swap[:, None, None], se3.inverse(T), T)
    moves = se3.orthonormalized(poses[before] @ T_before_after @ se3.inverse(poses[after]))  # else rounding doubles
    trials = np.concatenate([np.eye(4)[None], moves])
    costs = []
    for move in trials:
        moved = se3.inverse(T_before_after) @ se3.inverse(poses[before]) @ move @ poses[after]
        chi2 = mahalanobis(se3.log(moved), graph.covariances[loops])
        costs.append(np.log1p(chi2 / kernel**2).sum())
    return np.asarray(trials[int(np.argmin(costs))])
