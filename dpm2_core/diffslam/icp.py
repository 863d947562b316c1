# SPDX-License-Identifier: Apache-2.0
"""Point-to-plane ICP for a batch of pairs, differentiable in the points and weights of both clouds.

The association of points has no gradient: it is piecewise constant. Coordinates, normals and weights have one.
Selections act on the pose through weights; a boolean mask would have no gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor

from dpm2_core.config import Settings
from dpm2_core.diffslam.neighbors import NeighborSearch
from dpm2_core.diffslam.soft_lm import SoftLmSettings, solve
from dpm2_core.geometry import se3_torch

_NORMAL_NEIGHBORS = 10  # points of a cloud whose plane gives a normal
_MIN_GAP = 1e-3  # of eigenvalues, in units of their sum


class IcpSettings(Settings):
    """Registration of two scans."""

    solver: SoftLmSettings = SoftLmSettings()
    """Iterations, damping and gradient."""
    max_distance: float = Field(default=3.0, gt=0)
    """Matches that are farther apart are left out, m."""
    kernel: Literal["huber", "geman_mcclure", "none"] = "huber"
    """Robust kernel, which reduces the weight of large residuals."""
    kernel_scale: float = Field(default=0.2, gt=0)
    """Residual at which the kernel begins to take effect, m."""


class Cloud:
    """A batch of clouds, prepared for registration.

    Attributes:
        points: (B, N, 3) float64, m. weights: (B, N) 0..1, zero for padding. normals: (B, N, 3) unit.
    """

    def __init__(self, points: Tensor, weights: Tensor | None = None) -> None:
        """Take points (B, N, 3) and weights (B, N), all one if None; a point of weight zero is ignored."""
        self.points = points.double()
        self.weights = self.points.new_ones(points.shape[:2]) if weights is None else weights.double()
        self.search = NeighborSearch(self.points, self.weights.detach() > 0)
        self.normals = _normals(self.points, self.weights, self.search)

    def select(self, index: Sequence[int]) -> Cloud:
        """The clouds of the batch at these indices, without preparing them again."""
        out = copy(self)
        rows = torch.tensor(index, device=self.points.device)
        out.points, out.weights, out.normals = self.points[rows], self.weights[rows], self.normals[rows]
        out.search = self.search.select(index)
        return out


def register(source: Cloud, target: Cloud, T_init: Tensor, settings: IcpSettings) -> Tensor:
    """T_target_source (B, 4, 4) float64.

    Directions that the pair does not determine (a single plane, no matches, weights of zero) keep `T_init` and have no
    gradient. In nearly undetermined directions `solver.lambda_min` bounds the gradient. The result is finite.

    Args:
        source, target: B clouds each. T_init: (B, 4, 4), detached.
    """
    return solve(Matching(source, target, settings), T_init.detach().double()[:, None], settings.solver)[:, 0]


@torch.no_grad()
def matched(source: Cloud, target: Cloud, T: Tensor, settings: IcpSettings) -> Tensor:
    """(B,) share of the source's weight with a match at T_target_source (B, 4, 4); without gradient."""
    return Matching(source, target, settings).associate(T[:, None]).total / source.weights.sum(1).clamp(min=1e-9)


class Matching:
    """The `soft_lm.Problem` of `register`: each point of the source is matched to the nearest one of the target."""

    def __init__(self, source: Cloud, target: Cloud, settings: IcpSettings) -> None:
        self._source, self._target, self._settings = source, target, settings

    def associate(self, T: Tensor) -> _PlaneResiduals:
        source, target = self._source, self._target
        moved = se3_torch.transform(T[:, 0].detach(), source.points.detach())
        index = target.search.nearest(moved)[..., 0]
        matched = _gather(target.points, index)
        is_near = (matched.detach() - moved).norm(dim=-1) <= self._settings.max_distance
        weights = source.weights * target.weights.gather(1, index) * is_near
        return _PlaneResiduals(source.points, matched, _gather(target.normals, index), weights, self._settings)


class _PlaneResiduals:
    """`soft_lm.Residuals` r = n . (T p - q) of matched points p, q with normals n and weights, all (B, N, ...)."""

    def __init__(self, p: Tensor, q: Tensor, n: Tensor, weights: Tensor, settings: IcpSettings) -> None:
        self._p, self._q, self._n, self._settings = p, q, n, settings
        self.total = weights.sum(1)
        self._share = weights / self.total.clamp(min=1e-9)[:, None]

    def _residual(self, T: Tensor) -> Tensor:
        return (self._n * (se3_torch.transform(T[:, 0], self._p) - self._q)).sum(-1)

    def cost(self, T: Tensor) -> Tensor:
        r = self._residual(T)
        return (self._share * _rho(r, self._settings)).sum(1)

    def normal_equations(self, T: Tensor) -> tuple[Tensor, Tensor]:
        r = self._residual(T)
        n = self._n @ T[:, 0, :3, :3]  # in the frame of the source, where exp(delta) acts
        J = torch.cat([torch.linalg.cross(self._p, n), n], -1)
        WJ = (self._share * _irls_weight(r, self._settings))[..., None] * J
        return WJ.mT @ J, (WJ * r[..., None]).sum(1)


def _gather(values: Tensor, index: Tensor) -> Tensor:
    """Rows index (B, M) of values (B, N, 3)."""
    return values.gather(1, index[..., None].expand(-1, -1, 3))


def _rho(r: Tensor, settings: IcpSettings) -> Tensor:
    """Robust square of the residuals: r^2 for small ones."""
    s, square = settings.kernel_scale, r * r
    if settings.kernel == "none":
        return square
    if settings.kernel == "geman_mcclure":
        return square / (1 + square / s**2)
    return torch.where(r.abs() <= s, square, 2 * s * r.abs() - s * s)


def _irls_weight(r: Tensor, settings: IcpSettings) -> Tensor:
    """rho'(r) / 2r: the weight whose weighted least squares has the gradient of `_rho`."""
    s = settings.kernel_scale
    if settings.kernel == "none":
        return torch.ones_like(r)
    if settings.kernel == "geman_mcclure":
        return (1 + (r / s) ** 2) ** -2
    return s / r.abs().clamp(min=s)


def _normals(points: Tensor, weights: Tensor, search: NeighborSearch) -> Tensor:
    """Unit normals (B, N, 3) by weighted PCA over the nearest of each point; z where a point has no neighbors.

    They have the gradient of the eigenvector to first order: without it the derivative by one point is a third off. The
    gap to the other eigenvalues is bounded away from zero, as for neighborhoods on a line, which have no normal.
    """
    positions = points.detach()
    index = search.nearest(
        torch.where(weights.detach()[..., None] > 0, positions, torch.zeros_like(positions)), _NORMAL_NEIGHBORS
    )
    flat = index.flatten(1)
    neighbors = _gather(points, flat).unflatten(1, index.shape[1:])
    w = weights.gather(1, flat).unflatten(1, index.shape[1:])[..., None]
    w = w / w.sum(-2, keepdim=True).clamp(min=1e-12)
    centered = neighbors - (w * neighbors).sum(-2, keepdim=True)
    C = (w * centered).mT @ centered
    with torch.no_grad():
        values, vectors = torch.linalg.eigh(C)
        gap = values[..., :1] - values[..., 1:]
        inverse_gap = gap / (gap**2 + (_MIN_GAP * values.sum(-1, keepdim=True)) ** 2).clamp(min=1e-18)
        normal, others = vectors[..., :1], vectors[..., 1:]
    correction = inverse_gap[..., None] * (others.mT @ (C - C.detach()) @ normal)  # zero, except for its gradient
    return (normal + others @ correction)[..., 0]
