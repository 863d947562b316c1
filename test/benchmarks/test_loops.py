# SPDX-License-Identifier: Apache-2.0
"""Revisits are counted by their heading, wrong loops are detected, and a short road is driven to the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import Options
from benchmarks.loops import check_loops, revisits
from benchmarks.relocalise_visits import success_rates
from benchmarks.roads import road_files
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Edge, Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3


def there_and_back(lateral: float = 4.0) -> Array:
    """100 m straight ahead in steps of 5 m, and back at a lateral distance."""
    there = [se3.make(np.eye(3), np.array([x, 0, 0])) for x in np.arange(0, 101, 5.0)]
    turned = se3.exp(np.array([0, 0, np.pi, 0, 0, 0]))[:3, :3]
    back = [se3.make(turned, np.array([x, lateral, 0])) for x in np.arange(100, -1, -5.0)]
    return np.array(there + back)


def closure(a: int, b: int, T: Array, ok: bool = True) -> Edge:
    return Edge("loop", a, b, Registration(T, np.eye(6), 0.9, 0.1, "test", ok, "" if ok else "only 31% fit"))


def test_revisits_by_heading() -> None:
    truth = there_and_back()
    kinds = revisits(truth)
    assert kinds["same"] == kinds["cross"] == set()
    # 21 back; for the first of them, all poses within 10 m are less than 50 m away along the path
    assert kinds["reverse"] == set(range(26, 42))
    assert revisits(there_and_back(lateral=12.0))["reverse"] == set()
    twice = np.concatenate([truth[:21], truth[:21]])
    assert revisits(twice)["same"] >= set(range(21, 42))


def test_wrong_loops_and_found_revisits_are_told_apart() -> None:
    truth = there_and_back()

    def T(a: int, b: int) -> Array:
        return se3.inverse(truth[a]) @ truth[b]

    off = se3.make(np.eye(3), np.array([5.5, 0, 0]))
    turned = se3.exp(np.array([0, 0, np.radians(6), 0, 0, 0]))
    loops = [
        closure(2, 39, T(2, 39)), closure(3, 38, T(3, 38) @ off), closure(4, 37, T(4, 37) @ turned),
        closure(5, 36, T(5, 36), ok=False), closure(6, 35, T(6, 35) @ off, ok=False),
    ]  # fmt: skip
    result = check_loops(loops, truth)
    assert (result["tried"], result["accepted"], result["wrong"]) == (5, 3, 2)
    assert result["reverse"] == {"revisits": 16, "found": 1}  # rejected or wrong loops find nothing
    assert result["refusals"] == {"only fit": 2}


def test_an_answer_is_right_wrong_or_none() -> None:
    rows = [(True, 0.1, 0.2, 0.1), (True, 0.4, 0.2, 0.1), (True, 0.1, 1.2, 0.1), (False, 0.0, 0.0, 0.2)]
    result = success_rates(rows)
    assert (result["right"], result["wrong"], result["no_answer"]) == (0.25, 2, 1)


def test_missing_roads_are_an_error_of_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DPM2_KITTI", str(tmp_path))
    with pytest.raises(UsageError, match="no such pose file"):
        road_files(Options())
