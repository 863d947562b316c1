# SPDX-License-Identifier: Apache-2.0
"""The loss on the pose: what an error costs, that it trains the network, and that what has diverged does not."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dpm2_core.geometry import se3
from dpm2_core.learning.dataset import DataSettings, GroupDataset
from dpm2_core.learning.pair_sampling import merge_tokens
from dpm2_core.learning.pose_loss import FINE, differentiable_poses, pose_loss
from dpm2_core.learning.registration_loss import LossSettings
from dpm2_core.learning.train_registration import RegistrationTraining, RegistrationTrainingSettings, set_pairs_of
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pose_solver import solve_batch
from dpm2_core.network.tokens import Tokens

from ...helpers.networks import tiny

TRUTH = torch.from_numpy(se3.exp([0.01, -0.02, 1.0, 3.0, 0.5, 0.1]))[None]


@pytest.mark.parametrize("xi", [[0, 0, 0, 3, 4, 0], [0, 1, 0, 0, 0, 0]])
def test_a_large_error_costs_what_it_is_and_five_meters_a_radian(xi: list[float]) -> None:
    """Both are 5 m; the smooth part takes at most `FINE` off."""
    loss = float(pose_loss(TRUTH @ torch.from_numpy(se3.exp(xi)), TRUTH))
    assert 5 - FINE <= loss <= 5


def test_no_error_costs_nothing_and_has_a_finite_gradient() -> None:
    T = TRUTH.clone().requires_grad_(True)
    loss = pose_loss(T, TRUTH)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0, abs=1e-9)
    assert T.grad is not None
    assert bool(T.grad.isfinite().all())


def places(count: int, channels: int) -> tuple[Tokens, Tokens]:
    """The same places, each with a feature of its own, as two scans see them that are `TRUTH` apart."""
    noise = torch.Generator().manual_seed(0)
    xyz = torch.randn(1, count, 3, generator=noise) * torch.tensor([15.0, 15.0, 1.0])
    features, mask = torch.randn(1, count, channels, generator=noise), torch.ones(1, count, dtype=torch.bool)
    moved = (xyz.double() @ TRUTH[:, :3, :3].mT + TRUTH[:, None, :3, 3]).float()
    axes = [torch.nn.functional.normalize(p[..., :2], dim=-1) for p in (xyz, moved)]
    return Tokens(xyz, features, axes[0], mask), Tokens(moved, features, axes[1], mask)


def test_what_has_diverged_takes_the_truth_and_has_no_gradient() -> None:
    """The same pair is compared with a truth that it is near, and with one 3 m beside."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny()).eval()
    source, target = places(60, model.settings.channels)
    source = source._replace(features=source.features.clone().requires_grad_(True))
    with torch.no_grad():
        near, usable = differentiable_poses(model.decoder, source, target, model.decoder(source, target), TRUTH)
    beside = near.clone()
    beside[:, 0, 3] += 3.0
    T, kept = differentiable_poses(model.decoder, source, target, model.decoder(source, target), beside)
    assert bool(usable.all())
    assert not bool(kept.any())
    torch.testing.assert_close(T, beside)
    T.sum().backward()
    assert source.features.grad is not None
    assert float(source.features.grad.abs().max()) == 0.0


def test_registration_trains_by_it(packed: Path) -> None:
    """With every other loss switched off the encoder still has a gradient, and both figures are in the log."""
    torch.manual_seed(0)
    data = DataSettings(packed={str(packed): 1.0}, groups=1, frames=3, workers=0)
    loss = LossSettings(pairing=0, coarse=0, backbone=0, image=0, offset=0, pose=1, near=32, own=16)
    batch = GroupDataset(data, tiny(), data.draw, seed=0)[0, 0]
    module = RegistrationTraining(tiny(), loss)
    with torch.no_grad():  # the last layer of the offsets is zero at first, and passes no gradient on
        module.model.decoder.offset.out.weight.normal_(std=0.1)
    plan = set_pairs_of(batch.poses, RegistrationTrainingSettings(data=data, loss=loss, pairs=2, sets=0), 0)[0]
    tokens = module.model.encoder(batch.points, None).tokens
    source, target = (merge_tokens(tokens, side, plan.T_source, True) for side in (plan.source, plan.target))
    with torch.no_grad():
        solved = solve_batch(module.model.decoder, source, target, module.model.decoder(source, target))
    assert solved is not None
    beside = solved.T.float()
    beside[:, 0, 3] += 0.3  # not diverged, and not without an error
    total, figures = module(batch.points, None, (plan._replace(T_target_source=beside),))
    total.backward()
    assert float(figures["pose"]) > 0.1
    assert float(figures["diverged"]) == 0
    grads = [p.grad for p in module.model.encoder.points.parameters() if p.grad is not None]
    assert any(float(grad.abs().max()) > 0 for grad in grads)
