# SPDX-License-Identifier: Apache-2.0
"""The loss on the pose: the cost of an error, and its training of the network, from the truth after divergence."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dpm2_core.geometry import se3
from dpm2_core.learning.dataset import DataSettings, GroupDataset
from dpm2_core.learning.pair_sampling import merge_tokens
from dpm2_core.learning.pose_loss import DIVERGED, FINE, differentiable_poses, pose_loss
from dpm2_core.learning.registration_loss import LossSettings
from dpm2_core.learning.train_registration import RegistrationTraining, RegistrationTrainingSettings, set_pairs_of
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pose_solver import solve_batch
from dpm2_core.network.tokens import Tokens

from ...helpers.networks import tiny

TRUTH = torch.from_numpy(se3.exp([0.01, -0.02, 1.0, 3.0, 0.5, 0.1]))[None]


@pytest.mark.parametrize("size", [0.1, 0.5])
def test_five_meters_count_as_much_as_a_radian(size: float) -> None:
    """For both, the loss is that of the distance, apart from less than `FINE` for the smooth part."""
    costs = [
        float(pose_loss(TRUTH @ torch.from_numpy(se3.exp(xi)), TRUTH))
        for xi in ([0, 0, 0, 0.6 * size, 0.8 * size, 0], [0, size / 5, 0, 0, 0, 0])
    ]
    assert costs[0] == pytest.approx(costs[1])
    assert (size - FINE) / (1 + size) < costs[0] < size / (1 + size)


def test_farther_errors_cost_more_but_never_more_than_the_limit() -> None:
    """A pair that shows nothing of its motion does not dominate the others."""
    costs = [float(pose_loss(TRUTH @ torch.from_numpy(se3.exp([0, 0, 0, x, 0, 0])), TRUTH)) for x in (1, 3, 30, 300)]
    assert costs == sorted(costs)
    assert costs[-1] < DIVERGED


def test_no_error_costs_nothing_and_has_a_finite_gradient() -> None:
    T = TRUTH.clone().requires_grad_(True)
    loss = pose_loss(T, TRUTH)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0, abs=1e-9)
    assert T.grad is not None
    assert bool(T.grad.isfinite().all())


def places(count: int, channels: int) -> tuple[Tokens, Tokens]:
    """The same points, each with a distinct feature, as seen in two scans that are `TRUTH` apart."""
    noise = torch.Generator().manual_seed(0)
    xyz = torch.randn(1, count, 3, generator=noise) * torch.tensor([15.0, 15.0, 1.0])
    features, mask = torch.randn(1, count, channels, generator=noise), torch.ones(1, count, dtype=torch.bool)
    moved = (xyz.double() @ TRUTH[:, :3, :3].mT + TRUTH[:, None, :3, 3]).float()
    axes = [torch.nn.functional.normalize(p[..., :2], dim=-1) for p in (xyz, moved)]
    return Tokens(xyz, features, axes[0], mask), Tokens(moved, features, axes[1], mask)


def test_what_has_diverged_starts_at_the_truth_and_learns_what_pulls_it_away() -> None:
    """The same pair is compared with a truth near its pose, and with one 3 m away, from which it would diverge."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny()).eval()
    source, target = places(60, model.settings.channels)
    source = source._replace(features=source.features.clone().requires_grad_(True))
    with torch.no_grad():
        near, found = differentiable_poses(model.decoder, source, target, model.decoder(source, target), TRUTH)
    beside = near.clone()
    beside[:, 0, 3] += 3.0
    T, kept = differentiable_poses(model.decoder, source, target, model.decoder(source, target), beside)
    assert bool(found.all())
    assert not bool(kept.any())
    assert float((T.detach() - beside)[:, :3, 3].norm()) > 0.1
    assert float((T.detach() - near)[:, :3, 3].norm()) < 3.0
    pose_loss(T, beside).backward()
    assert source.features.grad is not None
    assert float(source.features.grad.abs().max()) > 0


def test_features_that_are_not_finite_take_the_truth() -> None:
    """The pose is then the truth, without a gradient, so that no gradient is NaN."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny()).eval()
    source, target = places(60, model.settings.channels)
    source = source._replace(features=torch.full_like(source.features, torch.nan))
    with torch.no_grad():
        T, kept = differentiable_poses(model.decoder, source, target, model.decoder(source, target), TRUTH)
    assert not bool(kept.any())
    torch.testing.assert_close(T, TRUTH)


def test_registration_trains_by_it(packed: Path) -> None:
    """With every other loss switched off the encoder still has a gradient, and both figures are in the log."""
    torch.manual_seed(0)
    data = DataSettings(packed={str(packed): 1.0}, groups=1, frames=3, workers=0)
    loss = LossSettings(pairing=0, coarse=0, backbone=0, image=0, offset=0, pose=1, near=32, own=16)
    batch = GroupDataset(data, tiny(), data.draw, seed=0)[0, 0]
    module = RegistrationTraining(tiny(), loss)
    with torch.no_grad():  # the last layer of the offsets is zero at first, and blocks the gradient
        module.model.decoder.offset.out.weight.normal_(std=0.1)
    plan = set_pairs_of(batch.poses, RegistrationTrainingSettings(data=data, loss=loss, pairs=2, sets=0), 0)[0]
    tokens = module.model.encoder(batch.points, None).tokens
    source, target = (merge_tokens(tokens, side, plan.T_source, True) for side in (plan.source, plan.target))
    with torch.no_grad():
        solved = solve_batch(module.model.decoder, source, target, module.model.decoder(source, target))
    assert solved is not None
    beside = solved.T.float()
    beside[:, 0, 3] += 0.3  # not diverged, but not exact
    total, figures = module(batch.points, None, (plan._replace(T_target_source=beside),))
    total.backward()
    assert float(figures["pose"]) > 0.1
    assert float(figures["diverged"]) == 0
    grads = [p.grad for p in module.model.encoder.points.parameters() if p.grad is not None]
    assert any(float(grad.abs().max()) > 0 for grad in grads)
