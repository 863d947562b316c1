# SPDX-License-Identifier: Apache-2.0
"""A window of scans along a street, seen from known poses."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor


@pytest.fixture
def noisy(scans: list[Tensor]) -> list[Tensor]:
    """The scans, each with independent noise of 1 cm: residuals are not zero at the minimum."""
    generator = torch.Generator().manual_seed(3)
    return [scan + 0.01 * torch.randn(scan.shape, generator=generator, dtype=scan.dtype) for scan in scans]
