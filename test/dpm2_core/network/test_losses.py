# SPDX-License-Identifier: Apache-2.0
"""Loss values on hand-made cases, and no NaN without positives."""

from __future__ import annotations

import math

import pytest
import torch

from dpm2_core.learning.train_overlap import OVERLAP
from dpm2_core.network.losses import (
    info_nce,
    label_distances,
    label_pairs,
    mahalanobis_offset,
    overlap_loss,
    student_offset,
)


def test_labels_of_a_hand_made_case() -> None:
    """The nearest within 1 m is positive, others within 1 m are near, padding is infinitely far; in both directions."""
    source = torch.tensor([[[0.0, 0, 0], [5, 0, 0], [9, 9, 9]]])
    target = torch.tensor([[[0.0, 0.4, 1], [0, 0.9, 1], [5, 3, 1], [9, 9, 10]]])
    up = torch.eye(4)[None].clone()
    up[0, 2, 3] = 1.0  # T_target_source
    masks = torch.tensor([[True, True, True]]), torch.tensor([[True, True, True, False]])
    labels = label_pairs(source, target, up, masks)
    assert labels.forward.tolist() == [[0, -1, -1]]
    assert labels.backward.tolist() == [[0, 0, -1, -1]]
    assert labels.near[0].nonzero().tolist() == [[0, 0], [0, 1]]
    assert labels.distance[0, :, 3].isinf().all()


@pytest.mark.parametrize("neutral_is_negative", [True, False])
def test_info_nce_value(neutral_is_negative: bool) -> None:
    """One row, one positive, one neutral and one negative: the softmax by hand."""
    labels = label_distances(torch.tensor([[[0.2, 0.6, 7.0]]]), 1.0)
    scores = torch.tensor([[[2.0, 1.0, 0.0]]])
    e = math.exp
    forward = -math.log(e(2) / (e(2) + (e(1) if neutral_is_negative else 0) + 1))
    # backward: the first two targets have the only source as positive, and no competitor
    assert info_nce(scores, labels, neutral_is_negative).item() == pytest.approx(forward / 2, rel=1e-5)


def test_losses_without_positives_are_zero_and_differentiable() -> None:
    """Without any common points the loss is zero, with finite gradients."""
    labels = label_distances(torch.full((2, 3, 4), 9.0), 1.0)
    scores = torch.randn(2, 3, 4, requires_grad=True)
    residual = torch.zeros(5, 3, requires_grad=True)
    loss = info_nce(scores, labels, True) + mahalanobis_offset(residual, torch.zeros(5))
    loss.backward()
    assert loss.item() == 0
    assert scores.grad is not None
    assert residual.grad is not None
    assert scores.grad.isfinite().all()
    assert residual.grad.isfinite().all()


def test_mahalanobis_weighs_by_the_spread_of_the_batch() -> None:
    """Below 4 residuals it is the mean length; otherwise every direction is weighted by its spread in the batch."""
    few = torch.tensor([[3.0, 4, 0], [0, 0, 1]])
    assert mahalanobis_offset(few, torch.ones(2)).item() == pytest.approx(3, rel=1e-4)
    torch.manual_seed(0)
    many = torch.randn(4000, 3) * torch.tensor([0.1, 1.0, 5.0])
    # the mean of the chi distribution with 3 degrees of freedom is 1.596; 4000 samples give it to 2 %
    assert mahalanobis_offset(many, torch.ones(4000)).item() == pytest.approx(1.596, rel=0.02)


def test_student_loss_is_least_at_the_true_precision() -> None:
    """As a function of the scale of the precision, the loss is least at the scale from which residuals were drawn."""
    torch.manual_seed(0)
    sigma = torch.tensor([0.1, 1.0, 0.5])
    chi = torch.distributions.Chi2(3.0).sample((20000, 1))
    residual = torch.randn(20000, 3) * (3 / chi).sqrt() * sigma
    losses = [
        student_offset(residual, torch.diag(scale / sigma).expand(20000, 3, 3), torch.ones(20000)).item()
        for scale in (0.7, 1.0, 1.4)
    ]
    assert losses[1] < losses[0]
    assert losses[1] < losses[2]


def test_loss_gradients() -> None:
    """Analytic against numeric derivatives in double."""
    torch.manual_seed(0)
    labels = label_distances(torch.rand(1, 4, 5, dtype=torch.float64) * 3, 1.0)
    scores = torch.randn(1, 4, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: info_nce(s, labels, False), scores)
    residual = torch.randn(6, 3, dtype=torch.float64, requires_grad=True)
    L = (torch.eye(3).double() * 2 + torch.rand(6, 3, 3).double().tril(-1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda r, m: student_offset(r, m, torch.ones(6).double()), (residual, L))


def test_overlap_label_is_twenty_meters() -> None:
    """A confident correct prediction costs nothing, a confident wrong one its logit."""
    distance = torch.tensor([20.0, 20.1])
    assert overlap_loss(torch.tensor([9.0, -9.0]), distance, OVERLAP).item() < 1e-3
    assert overlap_loss(torch.tensor([-9.0, 9.0]), distance, OVERLAP).item() == pytest.approx(9, abs=1e-3)
