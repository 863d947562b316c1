# SPDX-License-Identifier: Apache-2.0
"""SE(3) in torch: it agrees with numpy, and is twice differentiable at and around the identity and near pi."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpm2_core.geometry import se3, se3_torch

ANGLES = [0.0, 1e-9, 0.99e-4, 1.01e-4, 0.0099, 0.0101, 0.5, 2.0, 3.0, 3.1415]


def tangent(angle: float) -> np.ndarray:
    return np.append(np.array([0.48, -0.6, 0.64]) * angle, [1.0, -2.0, 3.0])


@pytest.mark.parametrize("angle", ANGLES)
def test_agrees_with_numpy(angle: float) -> None:
    """exp, and log back, on both sides of every boundary between series and closed form."""
    xi = tangent(angle)
    T = se3_torch.exp(torch.from_numpy(xi))
    np.testing.assert_allclose(T, se3.exp(xi), atol=1e-12)
    np.testing.assert_allclose(se3_torch.log(T), xi, atol=1e-8 if angle > 3 else 1e-11)
    np.testing.assert_allclose(se3_torch.inverse(T) @ T, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.99e-4, 1e-3, 0.5, 3.0])
def test_twice_differentiable(angle: float) -> None:
    """A NaN behind a `where` would be detected here."""
    xi = torch.from_numpy(tangent(angle)).requires_grad_()
    assert torch.autograd.gradcheck(se3_torch.exp, xi)
    assert torch.autograd.gradcheck(lambda xi: se3_torch.log(se3_torch.exp(xi)), xi, atol=1e-4 if angle > 2 else 1e-5)
    assert torch.autograd.gradgradcheck(se3_torch.exp, xi, atol=1e-4)
    assert torch.autograd.gradgradcheck(lambda xi: se3_torch.log(se3_torch.exp(xi)), xi, atol=1e-3)


def test_inverse_right_jacobian() -> None:
    """log(exp(w) exp(d)) = w + J d, compared with a finite difference."""
    for angle in ANGLES[:-2]:
        w = torch.from_numpy(tangent(angle)[:3])

        def moved(d: torch.Tensor, w: torch.Tensor = w) -> torch.Tensor:
            both = torch.nn.functional.pad(torch.stack([w, d]), (0, 3))
            R = se3_torch.exp(both)[:, :3, :3]
            return se3_torch.log_rotation(R[0] @ R[1])

        J = torch.stack([(moved(e) - moved(-e)) / 2e-6 for e in 1e-6 * torch.eye(3).double()], 1)
        torch.testing.assert_close(se3_torch.inverse_right_jacobian(w), J, atol=1e-8, rtol=0)


def test_batches_have_any_shape() -> None:
    """(2, 3, 6) to (2, 3, 4, 4); points by (2, 4, 4)."""
    xi = torch.rand(2, 3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)  # below pi
    T = se3_torch.exp(xi)
    torch.testing.assert_close(se3_torch.log(T), xi)
    points = torch.randn(2, 7, 3, dtype=torch.float64)
    requested = torch.stack([torch.from_numpy(se3.transform(T[i, 0].numpy(), points[i].numpy())) for i in range(2)])
    torch.testing.assert_close(se3_torch.transform(T[:, 0], points), requested)
