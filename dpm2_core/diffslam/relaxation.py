# SPDX-License-Identifier: Apache-2.0
"""Relaxation of a small pose graph, differentiable in the measured relative poses and in their weights."""

from __future__ import annotations

import torch
from torch import Tensor

from dpm2_core.diffslam.soft_lm import SoftLmSettings, solve
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3_torch


def relax(
    poses: Tensor,
    edges: Tensor,
    measured: Tensor,
    weights: Tensor | None = None,
    rotation_weight: float = 25.0,
    settings: SoftLmSettings | None = None,
) -> Tensor:
    """Poses (T, 4, 4) float64 that agree best with all measurements; the first one is fixed.

    The residual of an edge is its translation error, m, and its rotation error, rad, times the root of
    `rotation_weight`. Normal equations are dense, (6T)^2: for windows of up to some hundred scans.

    Args:
        poses: (T, 4, 4) T_map_scan to start from. edges: (E, 2) pairs (target, source), loops included.
        measured: (E, 4, 4) T_target_source. weights: (E,) 0..1, all one if None. rotation_weight: m2 / rad2.

    Raises:
        UsageError: an edge names a pose that does not exist, or the counts differ.
    """
    if edges.shape != (len(measured), 2):
        raise UsageError(f"pose graph: edges {tuple(edges.shape)} for {len(measured)} measured poses")
    if weights is not None and weights.shape != (len(measured),):
        raise UsageError(f"pose graph: weights {tuple(weights.shape)} for {len(measured)} measured poses")
    if len(edges) and not 0 <= int(edges.min()) <= int(edges.max()) < len(poses):
        raise UsageError(f"pose graph: an edge names pose {int(edges.max())} of {len(poses)}")
    if len(poses) < 2 or not len(edges):
        return poses.double()
    settings = settings or SoftLmSettings(iterations=5)
    w = measured.new_ones(len(measured)) if weights is None else weights
    graph = _Graph(poses[0].double(), edges, measured.double(), w.double(), rotation_weight)
    moved = solve(graph, poses[None, 1:].double(), settings)[0]
    return torch.cat([poses[:1].double(), moved])


class _Graph:
    """`soft_lm.Problem` and `Residuals` in one: there is no association. One batch entry, K = T - 1 poses."""

    def __init__(self, first: Tensor, edges: Tensor, measured: Tensor, weights: Tensor, rotation_weight: float) -> None:
        self._first, self._edges, self._measured = first, edges.to(measured.device), measured
        self.total = weights.sum()[None]
        self._share = weights / self.total.clamp(min=1e-9)
        self._scale = measured.new_tensor([rotation_weight**0.5] * 3 + [1.0] * 3)

    def associate(self, T: Tensor) -> _Graph:
        return self

    def _end_poses(self, T: Tensor) -> tuple[Tensor, Tensor]:
        poses = torch.cat([self._first[None], T[0]])
        return poses[self._edges[:, 0]], poses[self._edges[:, 1]]

    def _residual(self, relative: Tensor) -> Tensor:
        """(E, 6) scaled residuals of the relative poses found (E, 4, 4)."""
        Z = self._measured
        w = se3_torch.log_rotation(Z[:, :3, :3].mT @ relative[:, :3, :3])
        return self._scale * torch.cat([w, relative[:, :3, 3] - Z[:, :3, 3]], -1)

    def cost(self, T: Tensor) -> Tensor:
        target, source = self._end_poses(T)
        r = self._residual(se3_torch.inverse(target) @ source)
        return (self._share * (r * r).sum(-1)).sum()[None]

    def normal_equations(self, T: Tensor) -> tuple[Tensor, Tensor]:
        target, source = self._end_poses(T)
        relative = se3_torch.inverse(target) @ source
        r = self._residual(relative)
        R, zero = relative[:, :3, :3], torch.zeros_like(relative[:, :3, :3])
        J_r = se3_torch.inverse_right_jacobian(r[:, :3] / self._scale[:3])
        eye = torch.eye(3, dtype=R.dtype, device=R.device).expand_as(R)
        J_source = torch.cat([torch.cat([J_r, zero], -1), torch.cat([zero, R], -1)], -2)
        J_target = torch.cat(
            [torch.cat([-J_r @ R.mT, zero], -1), torch.cat([se3_torch.hat(relative[:, :3, 3]), -eye], -1)], -2
        )
        # Each edge's blocks, put into its columns; those of the first pose, which is fixed, are dropped.
        target_columns, source_columns = (
            torch.nn.functional.one_hot(self._edges, T.shape[1] + 1)[..., 1:].to(R.dtype).unbind(1)
        )
        J = torch.einsum("eij,ek->eikj", J_target, target_columns) + torch.einsum(
            "eij,ek->eikj", J_source, source_columns
        )
        J = (self._scale[:, None] * J.flatten(2)).flatten(0, 1)
        WJ = self._share.repeat_interleave(6)[:, None] * J
        return (WJ.mT @ J)[None], (WJ.mT @ r.flatten())[None]
