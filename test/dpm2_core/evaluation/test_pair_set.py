# SPDX-License-Identifier: Apache-2.0
"""Pairs of frames for evaluating a network: near and far ones, or an error that names the kind that is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.pair_set import PairSet
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import preset

from ...helpers.networks import tiny


def packed(folder: Path, at: np.ndarray, **about: object) -> Path:
    """A drive with frames at the given positions along x, m."""
    cloud = np.random.default_rng(0).uniform(-40, 40, (50, 3)).astype(np.float32)
    write_packed(
        folder / "drive", [Sample(cloud, se3.make(np.eye(3), [x, 0, 0])) for x in at], {"source": "test", **about}
    )
    return folder


@pytest.mark.parametrize("farthest", [20, 35])
def test_half_of_the_pairs_are_near(tmp_path: Path, farthest: float) -> None:
    pairs = PairSet(packed(tmp_path, np.arange(40.0)), 40, preset("small"), False, farthest).pairs
    distances = np.array([pair[3] for pair in pairs])
    assert len(pairs) == 40
    assert ((distances[::2] > 0) & (distances[::2] <= 5)).all()
    assert ((distances[1::2] > 5) & (distances[1::2] <= farthest)).all()
    assert distances.max() > farthest - 10  # 20 draws


@pytest.mark.parametrize(
    ("at", "missing"),
    [(np.arange(11) * 0.12, "5 to 20 m"), (np.arange(20) * 25.0, "0 to 5 m"), (np.zeros(1), "0 to 5 m")],
    ids=["a room", "far apart", "one frame"],
)
def test_drives_without_such_pairs_are_named(tmp_path: Path, at: np.ndarray, missing: str) -> None:
    """The error names the missing distance. Previously, the search for such pairs never ended, and a training with such
    a validation never began."""
    with pytest.raises(UsageError, match=rf"{tmp_path}: no two frames of a drive are {missing} apart"):
        PairSet(packed(tmp_path, at), 20, preset("small"), False)


def test_errors_in_a_room_are_those_of_the_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A room is packed five times as large; errors are divided by that. Previously, the table of a fine-tuning showed
    0.015 m instead of 0.003 m."""
    rows = np.array([[1.0 if i % 2 == 0 else 6.0, 0, 0.015, 0.1, 1.0] for i in range(20)])
    monkeypatch.setattr(PairSet, "errors", lambda self, model: rows)
    found = PairSet(packed(tmp_path, np.arange(40.0), scale=5.0), 20, preset("small"), False).measure(
        DeepPointMap2(tiny())
    )
    assert found["near_m"] == pytest.approx(0.003)
    assert (found["far_m"], found["near_success"]) == (pytest.approx(0.003), 1.0)
