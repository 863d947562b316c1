# SPDX-License-Identifier: Apache-2.0
"""A packed drive along a street of boxes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.geometry import se3


@pytest.fixture
def samples(street: Callable, make_image: Callable) -> list[Sample]:
    """Six scans, 1 m apart, of one place, each of other points of the same surfaces."""
    out = []
    for i in range(6):
        cloud = street(np.random.default_rng(1), 6000)
        chosen = np.random.default_rng(i).permutation(len(cloud))[:3000]
        T = se3.exp([0, 0, 0.05 * i, 1.0 * i, 0.1 * i, 0])
        image = make_image(np.random.default_rng(i), (64, 32))
        out.append(Sample(se3.transform(se3.inverse(T), cloud[chosen]).astype(np.float32), T, (image,)))
    return out


@pytest.fixture
def packed(samples: list[Sample], tmp_path: Path) -> Path:
    """Root of a folder with that drive, `world`."""
    write_packed(tmp_path / "data" / "world", samples, {"source": "boxes"})
    return tmp_path / "data"
