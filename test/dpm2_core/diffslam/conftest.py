# SPDX-License-Identifier: Apache-2.0
"""A window of scans along a street, seen from known poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from dpm2_core.geometry import se3, se3_torch

MOTION = se3.exp(np.array([0.002, -0.003, np.deg2rad(1.2), 0.8, 0.1, 0.02]))
"""From a scan to the next: 0.8 m, 1.2 deg."""


@pytest.fixture
def motion() -> Tensor:
    """(4, 4) T_scan_next."""
    return torch.from_numpy(MOTION)


@pytest.fixture
def scans(street: Callable[..., np.ndarray], noise: np.random.Generator) -> list[Tensor]:
    """Four scans (600, 3) float64 of the same points from poses `motion` apart."""
    world = torch.from_numpy(street(noise, points=600)).double()
    out = [world]
    for _ in range(3):
        out.append(se3_torch.transform(torch.from_numpy(se3.inverse(MOTION)), out[-1]))
    return out


@pytest.fixture
def noisy(scans: list[Tensor]) -> list[Tensor]:
    """The scans with 1 cm of noise, of their own each: residuals are not zero at the minimum."""
    generator = torch.Generator().manual_seed(3)
    return [scan + 0.01 * torch.randn(scan.shape, generator=generator, dtype=scan.dtype) for scan in scans]
