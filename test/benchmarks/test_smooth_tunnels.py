# SPDX-License-Identifier: Apache-2.0
"""Tunnels whose scans do not determine the motion along them: with an IMU and without."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks import smooth_tunnels


@pytest.mark.slow
def test_an_imu_is_worth_most_of_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no error until the last frame with another odometry."""
    monkeypatch.setattr(smooth_tunnels, "AFTER", (0, 20))
    frames, truth = smooth_tunnels.drive(7)
    told = [frame.guess is not None for frame in frames]
    assert told == [True] * smooth_tunnels.KNOWN + [False] * 20
    at_once, later = smooth_tunnels.errors(frames, truth)
    assert at_once < 0.1
    _, without = smooth_tunnels.errors((replace(frame, imu=None) for frame in frames), truth)
    assert later < 0.3 * without
