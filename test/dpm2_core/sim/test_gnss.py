# SPDX-License-Identifier: Apache-2.0
"""Simulated fixes: at the antenna's position, with the errors that they report. Nothing else in a drive changes."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.geometry import geodesy, se3
from dpm2_core.sim.gnss import Receiver
from dpm2_core.sim.settings import GnssConfig


def local(receiver: Receiver, places: np.ndarray) -> np.ndarray:
    """Positions (K, 3) east, north, up of the world's origin, m."""
    return np.asarray(se3.transform(se3.inverse(receiver.T_ecef_world), geodesy.ecef(places)))


def test_without_errors_it_is_where_the_antenna_is() -> None:
    receiver = Receiver(GnssConfig(noise=0, wander=0, antenna=(1, 2, 3)), np.random.default_rng(0))
    poses = np.array([se3.exp(np.array([0, 0, np.pi / 2, 0, 0, 0])), np.eye(4)])  # the first faces north
    poses[:, :3, 3] = [[100, 0, 0], [0, 50, 5]]
    np.testing.assert_allclose(local(receiver, receiver.measure(poses)), [[98, 1, 3], [1, 52, 8]], atol=1e-4)


def test_its_errors_are_as_large_as_it_says_and_stay_for_a_while() -> None:
    config = GnssConfig(rate=1, noise=0.3, wander=1.5, wander_time=20)
    errors = []
    for seed in range(40):
        receiver = Receiver(config, np.random.default_rng(seed))
        errors.append(local(receiver, receiver.measure(np.tile(np.eye(4), (100, 1, 1)))) - receiver.antenna)
    error = np.array(errors)
    np.testing.assert_allclose(error.std((0, 1)), receiver.sigmas, rtol=0.1)  # 40 drives of 5 wander times
    near, far = (np.mean(error[:, :-k] * error[:, k:]) / error.var() for k in (2, 60))
    assert near == pytest.approx(1.5**2 / (1.5**2 + 0.3**2) * np.exp(-2 / 20), abs=0.1)
    assert abs(far) < 0.2
