# SPDX-License-Identifier: Apache-2.0
"""Biases from machine code equal those from tensors; under autocast they are rounded once."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpm2_core.network import compiled_bias
from dpm2_core.network.attention import RelativeBias, zscore

HALF_ULP = 2**-8  # of bfloat16, relative


def close(found: torch.Tensor, exact: torch.Tensor, bf16: bool, atol: float) -> None:
    """Equal up to an error of float32 that grows with the largest term of a sum, then rounded to bfloat16 if `bf16`."""
    assert found.dtype == (torch.bfloat16 if bf16 else torch.float32)
    torch.testing.assert_close(found.float(), exact.float(), rtol=HALF_ULP if bf16 else 1e-5, atol=atol)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 70), st.floats(0.01, 200), st.integers(0, 2**31), st.booleans())
def test_relative_bias_is_that_of_the_tensors(n: int, spread: float, seed: int, bf16: bool) -> None:
    """This holds for any number of points, near or far, in a batch of two."""
    torch.manual_seed(seed)
    relative = RelativeBias(2, 3)
    torch.nn.init.normal_(relative.weight)
    xyz, axis = torch.randn(2, n, 3) * spread, torch.nn.functional.normalize(torch.randn(2, n, 2), dim=-1)
    exact = [bias.detach() for bias in relative(xyz, axis)]  # gradients are enabled, so tensors are used
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        found = relative(xyz, axis)
    for a, b in zip(found, exact, strict=True):
        close(a, b, bf16, atol=2e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 70), st.floats(0.01, 300), st.floats(0, 1), st.integers(0, 2**31), st.booleans())
def test_near_bias_is_the_zscore_of_the_decay(tokens: int, spread: float, hidden: float, seed: int, bf16: bool) -> None:
    """This includes rows where no token counts, or where all are so far away that the decay vanishes."""
    torch.manual_seed(seed)
    distance, counted = torch.rand(2, 4, tokens) * spread, torch.rand(2, 4, tokens) >= hidden
    alphas = (0.1, 1.0, 6.0)
    alpha = torch.tensor(alphas, dtype=torch.float64).view(1, -1, 1, 1)
    exact = zscore(torch.exp(-alpha * distance[:, None]) * counted[:, None])
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        close(compiled_bias.near_bias(distance, counted, alphas), exact, bf16, atol=5e-3)


def test_training_and_other_devices_keep_to_tensors() -> None:
    """The machine code has no gradient."""
    x = torch.zeros(1)
    assert not compiled_bias.applies(x)
    with torch.no_grad():
        assert compiled_bias.applies(x)
        assert not compiled_bias.applies(torch.zeros(1, device="meta"))


@pytest.mark.parametrize("bf16", [True, False])
@pytest.mark.parametrize("at", [0.0, 1e-3, 0.7, 40.0, 1e4])
def test_a_single_distance(at: float, bf16: bool) -> None:
    """Only the decay, from a bias whose only weight is that of one reach: exp(-d / 1 m)."""
    weight = torch.zeros(1, compiled_bias.DIRECTIONS + compiled_bias.DISTANCES)
    weight[0, compiled_bias.DIRECTIONS] = 1
    xyz, axis = torch.tensor([[[0.0, 0, 0], [at, 0, 0]]]), torch.tensor([[[1.0, 0], [1, 0]]])
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        found = compiled_bias.relative_bias(xyz, axis, weight, (1.0, 2.5, 6.0, 15.0, 40.0))[0, 0]
    exact = torch.exp(-torch.cdist(xyz[0], xyz[0]))
    close(found, exact, bf16, atol=4e-5)  # sqrt(1e-9) at 0 m
