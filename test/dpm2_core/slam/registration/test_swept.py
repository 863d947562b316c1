# SPDX-License-Identifier: Apache-2.0
"""Pose and motion during a sweep are estimated from a rigid guess, unless they contradict the beginning of the
sweep."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import curve, se3
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.swept import Swept, begun_steadily, register_sweep

HALF, SHARED, NOISE, GATE = 0.05, 10.0, 0.02, 1.0
WALLS = np.array([[1, 0, 0, 6], [-1, 0, 0, 5], [0, 1, 0, 4], [0, -1, 0, 7], [0, 0, 1, 1.5], [0, 0, -1, 2.0]], float)
"""A room: normals and distances from the origin, m."""
MOTION = st.lists(st.floats(-1, 1), min_size=18, max_size=18).map(lambda v: np.reshape(v, (3, 6)) * [[1], [8], [100]])


def sweep(T: Array, motion: Array, seed: int = 0) -> tuple[Scan, Array]:
    """2,000 points of the walls, seen during a sweep around T (4, 4), and the wall of each point."""
    rng = np.random.default_rng(seed)
    wall, times = rng.integers(0, 6, 2000), rng.uniform(-HALF, HALF, 2000)
    at = rng.uniform(-3, 3, (2000, 3))
    normal = WALLS[wall, :3]
    at += (WALLS[wall, 3] - np.einsum("ij,ij->i", at, normal) + rng.normal(0, NOISE, 2000))[:, None] * normal
    T_seen = se3.inverse(T @ curve.poses(times, motion))
    seen = np.einsum("nij,nj->ni", T_seen[:, :3, :3], at) + T_seen[:, :3, 3]
    return Scan(np.zeros((0, 4), np.float32), seen=seen, times=times), wall


def matched(wall: Array, points: Array, T: Array) -> tuple[Array, Array, Array]:
    at, normals = points @ T[:3, :3].T + T[:3, 3], WALLS[wall, :3].copy()
    off = np.einsum("ij,ij->i", at, normals) - WALLS[wall, 3]
    return np.where(np.abs(off) < GATE, off, np.nan), normals, np.full(len(at), NOISE**2)


def found(T: Array, motion: Array, seed: int = 0, guess: Array | None = None) -> Swept | None:
    """Result from a guess of the pose, with the beginning that a steady motion before the sweep gives."""
    scan, wall = sweep(T, motion, seed)
    T_start = T @ curve.poses(-HALF, motion)
    twist = motion[0] - HALF * motion[1] + HALF**2 / 2 * motion[2]
    beginning = begun_steadily(T_start @ se3.exp(-HALF * twist), twist, 2 * HALF, HALF, 10.0)
    return register_sweep(scan, partial(matched, wall), T if guess is None else guess, beginning, SHARED)


@settings(deadline=None)
@given(MOTION, st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6))
def test_the_pose_and_the_motion_are_found_from_a_wrong_guess(motion: Array, off: list[float]) -> None:
    T = se3.exp([0.1, -0.2, 0.5, 0.3, -0.4, 0.2])
    result = found(T, motion, guess=T @ se3.exp(off))
    assert result is not None
    error = se3.way(T, result.T)
    # 2 cm of noise, and 10 points count as one against the beginning: 2 mm; the ends are less certain.
    assert np.abs(error[:3]).max() < 0.004
    assert np.abs(error[3:]).max() < 0.01
    ends = np.array([-HALF, HALF])
    there = se3.log(se3.inverse(T @ curve.poses(ends, motion)) @ result.T @ curve.poses(ends, result.motion))
    assert np.abs(there[:, :3]).max() < 0.02
    assert np.abs(there[:, 3:]).max() < 0.05


def test_its_covariance_covers_its_errors() -> None:
    """The points are independent here, but count with a tenth of their information: the covariance is not too small."""
    rng, T, chi2 = np.random.default_rng(1), np.eye(4), []
    for seed in range(20):
        motion = rng.normal(size=(3, 6)) * [[0.5], [5], [50]]
        result = found(T, motion, seed)
        assert result is not None
        off = np.concatenate([se3.way(T, result.T), (result.motion - motion).ravel()])
        chi2.append(off @ np.linalg.solve(result.covariance, off))
    assert np.median(chi2) < 24  # degrees of freedom


@pytest.mark.parametrize("speed", [2.0, 3.0])
def test_times_that_run_backwards_contradict_how_the_sweep_began(speed: float) -> None:
    twist, wall = np.array([0, 0, 0.3, speed, 0, 0]), np.zeros(0)
    scan, wall = sweep(np.eye(4), twist[None])
    beginning = begun_steadily(se3.exp(-0.1 * twist), twist, 0.1, HALF, 10.0)
    backwards = Scan(scan.points, seen=scan.seen, times=-scan.times)
    assert register_sweep(scan, partial(matched, wall), np.eye(4), beginning, SHARED) is not None
    assert register_sweep(backwards, partial(matched, wall), np.eye(4), beginning, SHARED) is None


def test_the_next_sweep_begins_where_one_ended_and_after_a_pause_less_is_known() -> None:
    motion = np.array([[0.1, 0, 0.5, 2, 0, 0.1], [0, 1, 0, 3, 0, 0], [10, 0, 0, 0, 20, 0]], float)
    one = found(np.eye(4), motion)
    assert one is not None
    end = one.T @ curve.poses(HALF, one.motion)
    beginning = one.next(2 * HALF, HALF, 10.0)
    np.testing.assert_allclose(beginning.T, end, atol=1e-12)
    way = se3.log(se3.inverse(end) @ one.T @ curve.poses(HALF + 1e-5, one.motion)) / 1e-5
    np.testing.assert_allclose(
        beginning.twist, way, atol=0.06
    )  # the curve rotates: the twist is its slope only to first order
    later = one.next(0.5, HALF, 10.0)
    np.testing.assert_allclose(later.T, end @ se3.exp(0.4 * beginning.twist), atol=1e-12)
    assert (np.diag(later.covariance) > np.diag(beginning.covariance)).all()
    assert np.linalg.eigvalsh(beginning.covariance)[0] > 0


def test_what_a_camera_adds_to_the_pose_was_motion_too() -> None:
    """Along a tunnel the points show no motion, so a pose farther ahead means a faster sweep."""
    sigma = np.repeat([0.001, 1e-3, 0.1, 1.0, 10.0, 10.0, 100.0, 100.0], 3)
    covariance = np.diag(sigma**2)
    start_sigma, h = 0.01, HALF  # the sweep began at a known position: pose = start + h * twist
    covariance[3, 3] = start_sigma**2 + h**2 * covariance[9, 9]
    covariance[3, 9] = covariance[9, 3] = h * covariance[9, 9]
    one = Swept(np.eye(4), np.zeros((3, 6)), covariance, h)
    T = se3.exp([0, 0, 0, 0.04, 0, 0])
    moved = one.placed(Registration(T, np.diag([1e-6] * 6), 1.0, 0.0, "visual"))
    np.testing.assert_array_equal(moved.T, T)
    assert moved.motion[0, 3] == pytest.approx(0.04 / h, rel=0.1)
    np.testing.assert_allclose(np.delete(moved.motion[0], 3), 0, atol=1e-9)
    assert moved.covariance[9, 9] < covariance[9, 9]
