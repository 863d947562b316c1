# SPDX-License-Identifier: Apache-2.0
"""Biased attention: z-scores, masks, and what a row without tokens gives."""

from __future__ import annotations

import pytest
import torch

from dpm2_core.network.attention import Attention, RelativeBias, sine_code, zscore


def test_zscore_rows() -> None:
    """Rows have mean 0 and deviation 1 over the readable tokens only; unreadable ones are 0."""
    values = torch.rand(2, 5, 30, dtype=torch.float64)
    mask = torch.rand(2, 1, 30) > 0.3
    out = zscore(values, mask)
    for b in range(2):
        row = out[b][:, mask[b, 0]]
        torch.testing.assert_close(row.mean(1), torch.zeros(5, dtype=torch.float64), atol=1e-12, rtol=0)
        torch.testing.assert_close(row.std(1, correction=0), torch.ones(5, dtype=torch.float64), atol=1e-9, rtol=0)
        assert (out[b][:, ~mask[b, 0]] == 0).all()


def test_zscore_of_constant_and_of_fully_masked_rows_is_zero() -> None:
    """There is no division by a vanishing deviation."""
    assert (zscore(torch.full((1, 3, 8), 0.7)).abs() < 1e-3).all()
    assert (zscore(torch.rand(1, 3, 8), torch.zeros(1, 1, 8, dtype=torch.bool)) == 0).all()


def test_masked_tokens_are_never_read() -> None:
    """Changing a masked token changes nothing; a row without any token gives exactly zero, with a finite gradient."""
    torch.manual_seed(0)
    attention = Attention(16, 4)
    x, tokens = torch.randn(2, 6, 16, requires_grad=True), torch.randn(2, 9, 16)
    mask = torch.ones(2, 1, 6, 9, dtype=torch.bool)
    mask[0, :, :, 5:] = False
    mask[1, :, 2] = False
    bias = torch.randn(2, 1, 6, 9)
    out = attention(x, tokens, bias, mask)
    tokens = tokens.clone()
    tokens[0, 5:] += 100
    torch.testing.assert_close(attention(x, tokens, bias, mask), out)
    assert (out[1, 2] == 0).all()
    out.sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()


def test_attention_against_the_formula() -> None:
    """Softmax over tokens of q.k / sqrt(d) + bias, times values, per head, as torch's own kernel computes it."""
    torch.manual_seed(0)
    attention = Attention(16, 4).double()
    x, tokens = torch.randn(2, 6, 16).double(), torch.randn(2, 9, 16).double()
    bias = torch.randn(2, 4, 6, 9).double()
    assert attention.query is not None
    assert attention.key is not None
    q, k, v = (
        layer(y).view(2, -1, 4, 4).transpose(1, 2)
        for layer, y in ((attention.query, x), (attention.key, tokens), (attention.value, tokens))
    )
    expected = torch.nn.functional.scaled_dot_product_attention(q, k, v, bias).transpose(1, 2).reshape(2, 6, 16)
    torch.testing.assert_close(attention(x, tokens, bias, None), attention.out(expected))


def test_without_learnable_similarity_the_bias_alone_decides() -> None:
    """The aggregate does not depend on the query, and a bias is required."""
    attention = Attention(16, 4, learnable=False)
    tokens, bias = torch.randn(1, 9, 16), torch.randn(1, 1, 6, 9)
    one, other = (attention(torch.randn(1, 6, 16), tokens, bias, None) for _ in range(2))
    torch.testing.assert_close(one, other)
    with pytest.raises(ValueError, match="spatial bias"):
        attention(torch.randn(1, 6, 16), tokens, None, None)


def test_attention_gradients() -> None:
    """Analytic against numeric derivatives in double, with bias and mask."""
    torch.manual_seed(0)
    attention = Attention(4, 2).double()
    x = torch.randn(1, 3, 4, dtype=torch.float64, requires_grad=True)
    tokens = torch.randn(1, 4, 4, dtype=torch.float64, requires_grad=True)
    bias = torch.randn(1, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    mask = torch.tensor([[[[True, True, False, True]]]])
    assert torch.autograd.gradcheck(lambda *args: attention(*args, mask), (x, tokens, bias))


def test_relative_bias_turns_with_the_sensor() -> None:
    """Rotating points and their axes together does not change the bias: it does not depend on the heading."""
    torch.manual_seed(0)
    relative = RelativeBias(2, 4)
    torch.nn.init.normal_(relative.weight)
    xyz, axis = torch.randn(1, 20, 3) * 10, torch.nn.functional.normalize(torch.randn(1, 20, 2), dim=-1)
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]])
    turned = torch.cat([xyz[..., :2] @ turn.T, xyz[..., 2:]], -1)
    for a, b in zip(relative(xyz, axis), relative(turned, axis @ turn.T), strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=0)


def test_sine_code_of_known_values() -> None:
    """The first pair of each axis is sin and cos of pi x; channels that three axes cannot fill are zero."""
    code = sine_code(torch.tensor([0.5, 0.0, 1.0]), 256)
    assert code.shape == (256,)
    torch.testing.assert_close(code[[0, 1, 84, 85, 168, 169]], torch.tensor([1.0, 0, 0, 1, 0, -1]), atol=1e-6, rtol=0)
    assert (code[252:] == 0).all()


def test_a_mask_that_hides_nothing_changes_nothing() -> None:
    torch.manual_seed(0)
    attention = Attention(16, 4)
    x, tokens, bias = torch.randn(2, 6, 16), torch.randn(2, 9, 16), torch.randn(2, 1, 6, 9)
    shown = attention(x, tokens, bias, torch.ones(2, 1, 1, 9, dtype=torch.bool))
    assert torch.equal(shown, attention(x, tokens, bias, None))
