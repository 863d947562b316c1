# SPDX-License-Identifier: Apache-2.0
"""Registration: known motion, gradients against finite differences and each other, weights, degenerate scenes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from dpm2_core.diffslam.icp import Cloud, IcpSettings, Matching, register
from dpm2_core.diffslam.soft_lm import SoftLmSettings, iterates
from dpm2_core.geometry import se3, se3_torch

EYE = torch.eye(4).double()[None]


def error(found: Tensor, wanted: Tensor) -> tuple[float, float]:
    """Translation and rotation error, m and rad."""
    e = se3.inverse(wanted.numpy()) @ found.detach().numpy()
    return float(np.linalg.norm(e[:3, 3])), float(se3.angle(e))


def settings(iterations: int = 8, **solver: object) -> IcpSettings:
    return IcpSettings(solver=SoftLmSettings(iterations=iterations, **solver))


def test_known_motion_is_recovered(scans: list[Tensor], motion: Tensor) -> None:
    """0.8 m and 1.2 deg from identity in the default 8 iterations, to 1 mm and 0.01 deg."""
    found = register(Cloud(scans[1][None]), Cloud(scans[0][None]), EYE, settings())
    meters, radians = error(found[0], motion)
    assert meters < 1e-3
    assert radians < np.deg2rad(0.01)


def test_printed_gate_does_not_converge_and_gradslam_hides_it(scans: list[Tensor], motion: Tensor) -> None:
    """Equation 5 as printed accepts nothing of a good step; to the power 1/200 it accepts some."""
    source, target = Cloud(scans[1][None]), Cloud(scans[0][None])
    left = {}
    for gate in ("soft", "none", "gradslam", "paper"):
        found = register(source, target, EYE, settings(gate=gate))
        left[gate] = error(found[0], motion)[0]
    assert left["paper"] > 0.7  # of 0.81
    assert left["soft"] < 1e-3
    assert left["gradslam"] < 0.02
    assert left["none"] < 1e-3


def test_error_falls_with_every_iteration(scans: list[Tensor], motion: Tensor) -> None:
    """Until it is below 0.1 mm."""
    solving = Matching(Cloud(scans[1][None]), Cloud(scans[0][None]), settings())
    errors = [error(T[0, 0], motion)[0] for T in iterates(solving, EYE[:, None], SoftLmSettings())]
    assert all(b < a for a, b in pairwise(errors) if a > 1e-4)


def test_batch_and_padding_change_nothing(noisy: list[Tensor]) -> None:
    """Pairs in one batch, padded by points of weight zero (but not NaN), give the same result as each alone."""
    alone = [register(Cloud(noisy[i + 1][None]), Cloud(noisy[i][None]), EYE, settings()) for i in range(2)]
    pad = torch.full((100, 3), 1.0).double()
    points = torch.stack([torch.cat([scan, pad]) for scan in noisy[:3]])
    weights = torch.cat([torch.ones(3, 600), torch.zeros(3, 100)], 1)
    scans = Cloud(points, weights)
    both = register(scans.select([1, 2]), scans.select([0, 1]), EYE.expand(2, 4, 4), settings())
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-9, rtol=0)


@pytest.mark.slow
def test_gradcheck_in_double(noisy: list[Tensor]) -> None:
    """For the gradient of the pose by points and weights of both clouds, with 12 points, through 2 iterations.

    Normals are given; associations do not change, since the points are far apart.
    """
    generator = torch.Generator().manual_seed(1)
    p = torch.randn(1, 12, 3, generator=generator, dtype=torch.float64) * 5
    n = torch.nn.functional.normalize(torch.randn(1, 12, 3, generator=generator, dtype=torch.float64), dim=-1)
    q = p + 0.05 * torch.randn(1, 12, 3, generator=generator, dtype=torch.float64)
    w = torch.rand(1, 12, generator=generator, dtype=torch.float64) * 0.8 + 0.1

    for solver in (settings(2), settings(2).model_copy(update={"kernel": "geman_mcclure", "kernel_scale": 0.5})):

        def pose(p: Tensor, q: Tensor, w: Tensor, v: Tensor, how: IcpSettings = solver) -> Tensor:
            target = Cloud(q.detach(), v.detach())
            target.normals, target.points, target.weights = n, q, v
            return register(Cloud(p, w), target, EYE, how)[:, :3]

        inputs = tuple(x.clone().requires_grad_() for x in (p, q, w, w.flip(1)))
        assert torch.autograd.gradcheck(pose, inputs, eps=1e-7, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("kernel", ["huber", "geman_mcclure", "none"])
def test_implicit_gradient_is_the_unrolled_one_at_convergence(noisy: list[Tensor], kernel: str) -> None:
    """Gradients agree within 1 % of their length, after 40 iterations; values within 1e-9."""
    gradients, poses = [], []
    for gradient in ("unrolled", "implicit"):
        source = noisy[1].clone()[None].requires_grad_()
        target = noisy[0].clone()[None].requires_grad_()
        how = IcpSettings(kernel=kernel, kernel_scale=1.0, solver=SoftLmSettings(iterations=40, gradient=gradient))
        T = register(Cloud(source), Cloud(target), EYE, how)
        gradients.append(torch.cat(torch.autograd.grad(T[0, :3, 3].square().sum() + 25 * T[0, 0, 1], (source, target))))
        poses.append(T.detach())
    torch.testing.assert_close(poses[0], poses[1], atol=1e-9, rtol=0)
    assert float((gradients[0] - gradients[1]).norm() / gradients[0].norm()) < 0.01


def test_points_of_little_weight_have_little_to_say(noisy: list[Tensor], motion: Tensor) -> None:
    """A third of the scan moves independently; the lower its weight, the more the pose follows the rest."""
    moving = noisy[1].clone()
    moving[:200, 0] += 1.0
    errors = []
    for weight in (1.0, 0.1, 0.0):
        w = torch.ones(1, 600).double()
        w[:, :200] = weight
        errors.append(error(register(Cloud(moving[None], w), Cloud(noisy[0][None]), EYE, settings(20))[0], motion)[0])
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.01  # as without the third: noise of 1 cm on 400 points


def test_weights_receive_a_gradient(noisy: list[Tensor]) -> None:
    """The weights of both clouds do, so that a selection can be learned."""
    w = torch.full((1, 600), 0.5, dtype=torch.float64, requires_grad=True)
    v = torch.full((1, 600), 0.5, dtype=torch.float64, requires_grad=True)
    register(Cloud(noisy[1][None], w), Cloud(noisy[0][None], v), EYE, settings())[0, 0, 3].backward()
    assert float(w.grad.norm()) > 0  # type: ignore[union-attr]
    assert float(v.grad.norm()) > 0  # type: ignore[union-attr]


def test_single_plane_moves_only_along_its_normal(noise: np.random.Generator) -> None:
    """Motion that a plane does not determine stays at the guess; everything is finite, including gradients."""
    flat = torch.from_numpy(np.column_stack([noise.uniform(-20, 20, (400, 2)), np.full(400, -1.7)]))
    lower = (flat - torch.tensor([0, 0, 0.1])).requires_grad_()
    for gradient in ("unrolled", "implicit"):
        T = register(Cloud(lower[None]), Cloud(flat[None]), EYE, settings(gradient=gradient))
        np.testing.assert_allclose(T[0, :3, 3].detach(), [0, 0, 0.1], atol=2e-3)
        assert se3.angle(T[0].detach().numpy()) < 1e-6
        (slope,) = torch.autograd.grad(T.sum(), lower)
        assert bool(slope.isfinite().all())


@pytest.mark.parametrize("gradient", ["unrolled", "implicit"])
def test_without_evidence_the_guess_stays(scans: list[Tensor], motion: Tensor, gradient: str) -> None:
    """With weights of zero, or clouds that are far from each other, the guess is returned, with a gradient of zero."""
    far = (scans[1] + 1000.0)[None].requires_grad_()
    near = scans[1][None].clone().requires_grad_()
    for source, weights in ((far, torch.ones(1, 600)), (near, torch.zeros(1, 600))):
        T = register(Cloud(source, weights), Cloud(scans[0][None]), motion[None], settings(gradient=gradient))
        torch.testing.assert_close(T[0], motion, atol=1e-12, rtol=0)
        (slope,) = torch.autograd.grad(T.sum(), source)
        assert float(slope.abs().max()) == 0.0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_gpu_gives_the_poses_of_the_cpu(noisy: list[Tensor]) -> None:
    """Both find the same neighbors; sums differ in their order."""
    a, b = torch.stack(noisy[:2]), torch.stack(noisy[1:3])
    cpu = register(Cloud(b), Cloud(a), EYE.expand(2, 4, 4), settings())
    gpu = register(Cloud(b.cuda()), Cloud(a.cuda()), EYE.expand(2, 4, 4).cuda(), settings())
    torch.testing.assert_close(gpu.cpu(), cpu, atol=1e-6, rtol=0)


def test_translation_of_the_frames_is_no_matter(noisy: list[Tensor]) -> None:
    """In another frame of reference the motion is the conjugate."""
    A = torch.from_numpy(se3.exp(np.array([0.1, -0.2, 1.0, 3.0, -2.0, 1.0])))
    T = register(Cloud(noisy[1][None]), Cloud(noisy[0][None]), EYE, settings(30))[0]
    moved = [se3_torch.transform(A, cloud)[None] for cloud in noisy[:2]]
    there = register(Cloud(moved[1]), Cloud(moved[0]), EYE, settings(30))[0]
    torch.testing.assert_close(se3_torch.inverse(A) @ there @ A, T, atol=1e-4, rtol=0)
