# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt on SE(3) without its hard decisions, so that a gradient passes through every iteration.

BMVC 2023, section 3: a step is not accepted or rejected. Its look-ahead error sets the damping of the next step (eq. 4)
and the part of this step that is taken (eq. 5). Equation 5 is printed with the wrong sign: the worse a step, the more
of it is taken. The gate here has the sign corrected; the printed one remains for comparison.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, Protocol

import torch
from pydantic import Field
from torch import Tensor

from dpm2_core.config import Settings
from dpm2_core.geometry import se3_torch

_MAX_EXPONENT = 70.0  # limit of the exponent: beyond it a sigmoid in float64 has no gradient
_MIN_COST = 1e-8  # m2: a fit better than 0.1 mm is perfect; keeps the relative change finite there
_GRADSLAM_NU = 200.0


class SoftLmSettings(Settings):
    """The solver of `icp` and `relaxation`."""

    iterations: int = Field(default=8, ge=1)
    """Steps, each with one association of the points."""
    lambda_min: float = Field(default=1e-5, gt=0)
    """Smallest damping, in units of the mean squared Jacobian of a residual: it fixes directions without evidence."""
    lambda_max: float = Field(default=1e-3, gt=0)
    """Largest damping, same units."""
    steepness: float = Field(default=1.0, gt=0)
    """Sigma of eq. 4."""
    offset: float = Field(default=1.0, gt=0)
    """D of eq. 4: at 1 an unchanged error gives the mean of both dampings."""
    gate: Literal["soft", "paper", "gradslam", "none"] = "soft"
    """Part of a step that is taken: eq. 5 with its sign corrected; as printed; as in gradslam (power 1/200); all."""
    sensitivity: float = Field(default=10.0, gt=0)
    """Gates soft and none: the exponent if the error doubles. Sums of squares saturate it, means leave it at zero."""
    lenience: float = 4.0
    """Gate soft: half of a step is taken if the exponent has this value, nearly all of one that changes nothing. At 0,
    as in eq. 5, the last steps are halved: after 8 iterations poses and gradients have not converged."""
    gradient: Literal["unrolled", "implicit"] = "unrolled"
    """Through all iterations, or by the implicit function theorem at the last one: less memory, exact if converged."""


class Residuals(Protocol):
    """A least-squares problem over K poses in each of B independent batch entries, with its associations fixed."""

    def cost(self, T: Tensor) -> Tensor:
        """(B,) mean squared residual, m2, at T (B, K, 4, 4)."""

    def normal_equations(self, T: Tensor) -> tuple[Tensor, Tensor]:
        """J^T W J (B, 6K, 6K) and J^T W r (B, 6K), both means, for steps T @ exp(delta)."""

    @property
    def total(self) -> Tensor:
        """(B,) sum of the weights that `cost` is the mean over."""


class Problem(Protocol):
    """What `solve` minimizes."""

    def associate(self, T: Tensor) -> Residuals:
        """The residuals around T (B, K, 4, 4); the association of points has no gradient."""


def retract(T: Tensor, step: Tensor) -> Tensor:
    """T (B, K, 4, 4) moved by step (B, 6K)."""
    return T @ se3_torch.exp(step.unflatten(-1, (-1, 6)))


def next_damping(change: Tensor, settings: SoftLmSettings) -> Tensor:
    """Eq. 4: from `lambda_min` (the error fell) to `lambda_max` (it rose), for change (B,)."""
    low, high = settings.lambda_min, settings.lambda_max
    exponent = (-settings.steepness * change).clamp(-_MAX_EXPONENT, _MAX_EXPONENT)
    return low + (high - low) / (1 + settings.offset * exponent.exp())


def step_gate(change: Tensor, settings: SoftLmSettings) -> Tensor:
    """Part of the step that is taken, 0..1, for the change of error (B,) that the whole step would bring."""
    if settings.gate == "soft":
        return torch.sigmoid(settings.lenience - change)
    if settings.gate == "paper":
        return torch.sigmoid(change)
    if settings.gate == "gradslam":
        return torch.sigmoid(change) ** (1 / _GRADSLAM_NU)
    return torch.ones_like(change)


def error_change(before: Tensor, after: Tensor, total: Tensor, settings: SoftLmSettings) -> Tensor:
    """(B,) exponent of both rules, negative if the step reduces the error.

    It is relative to the error before, so that it depends neither on the number of points nor on the scale of the
    scene; the rules as printed use the difference of the sums of squares.
    """
    if settings.gate in ("paper", "gradslam"):
        change = total * (after - before)
    else:
        change = settings.sensitivity * (after - before) / (before + _MIN_COST)
    return change.clamp(-_MAX_EXPONENT, _MAX_EXPONENT)


def iterates(problem: Problem, T: Tensor, settings: SoftLmSettings) -> Iterator[Tensor]:
    """The estimate (B, K, 4, 4) after each iteration, starting at T; differentiable if the problem is."""
    damping = T.new_full((len(T),), settings.lambda_min)
    for _ in range(settings.iterations):
        residuals = problem.associate(T)
        H, g = residuals.normal_equations(T)
        eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        factor = torch.linalg.cholesky(H + damping[:, None, None] * eye)
        step = -torch.cholesky_solve(g[..., None], factor)[..., 0]
        before, after = residuals.cost(T), residuals.cost(retract(T, step))
        change = error_change(before, after, residuals.total, settings)
        damping = next_damping(change, settings)
        T = retract(T, step_gate(change, settings)[:, None] * step)
        yield T


def solve(problem: Problem, T: Tensor, settings: SoftLmSettings) -> Tensor:
    """The minimum (B, K, 4, 4) found from T, with the gradient that `settings.gradient` names."""
    if settings.gradient == "unrolled" or not torch.is_grad_enabled():
        return list(iterates(problem, T, settings))[-1]
    with torch.no_grad():
        T = list(iterates(problem, T, settings))[-1]
    return _attach_gradient(problem.associate(T), T, settings.lambda_min)


def _attach_gradient(residuals: Residuals, T: Tensor, floor: float) -> Tensor:
    """T with the gradient of the minimum: one Newton step, of length zero where T is the minimum.

    At the minimum g(T, clouds) = 0, hence dT = -(dg/dT)^-1 dg. The Jacobian is that of g itself and not J^T W J: the
    iterations, too, converge to its solution, and the two differ as far as the residuals are not zero.
    """
    step = torch.zeros(len(T), 6 * T.shape[1], dtype=T.dtype, device=T.device, requires_grad=True)
    g = residuals.normal_equations(retract(T, step))[1]
    rows = [torch.autograd.grad(g[:, d].sum(), step, retain_graph=True)[0] for d in range(g.shape[1])]
    K = torch.stack(rows, 1) + floor * torch.eye(g.shape[1], dtype=T.dtype, device=T.device)
    return retract(T, -torch.linalg.solve(K, g[..., None])[..., 0])
