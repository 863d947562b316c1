# SPDX-License-Identifier: Apache-2.0
"""The benchmark of sweeps in motion on a few scans: a ride is compared from scan to scan, and shakes as specified."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import motion
from benchmarks.harness import Options
from dpm2_core.geometry import se3
from dpm2_core.sim.simulated_drive import RIDES


@pytest.mark.long
def test_a_ride_is_compared_from_scan_to_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion, "WORLDS", {"suburb": ("suburb", 920, 16, ("walking",))})
    monkeypatch.setattr(motion, "FRAMES", 26)
    options = Options(threads=1, out=tmp_path, overrides=("slam.registration=geometric",))
    results = motion.bench_motion(options).results
    row = results["rides"]["suburb, walking"]
    assert row["dpm2"] == row["dpm2 geometric"]
    assert row["dpm2"]["failed_frames"] == 0
    assert 0 < row["dpm2"]["rpe_m"] < 0.02
    assert row["dpm2"]["rpe_m"] <= row["dpm2"]["worst_m"]
    if motion.BASELINE in row:
        assert row["dpm2"]["rpe_m"] < row[motion.BASELINE]["rpe_m"]


def test_a_ride_begins_at_rest_and_shakes_as_it_says() -> None:
    ride = RIDES["waved"]
    np.testing.assert_array_equal(ride.shaken(np.array([0.0, 1.0])), np.tile(np.eye(4), (2, 1, 1)))
    times = np.linspace(10, 30, 4000)
    way = se3.log(ride.shaken(times))
    np.testing.assert_allclose(np.abs(way).max(0), ride.shakes[0], rtol=0.01)
