# SPDX-License-Identifier: Apache-2.0
"""SE(3) satisfies the laws of its group and of its exponential map, for every size of rotation and any batch shape."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from dpm2_core.geometry import se3

TURN = 3.1  # rad; a little below pi, where the logarithm is no longer unique


@st.composite
def tangents(draw: st.DrawFn, turn: float = TURN, reach: float = 100.0) -> np.ndarray:
    """Tangent (6,) with a rotation from exactly zero over tiny angles to `turn` rad, and a translation up to `reach`
    m."""
    axis = draw(arrays(np.float64, 3, elements=st.floats(-1, 1)))
    length = np.linalg.norm(axis)
    axis = axis / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    theta = draw(st.one_of(st.just(0.0), st.floats(0, turn), st.floats(-14, 0).map(lambda e: 10.0**e)))
    return np.concatenate([theta * axis, draw(arrays(np.float64, 3, elements=st.floats(-reach, reach)))])


def _twist_matrix(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.hat(xi[:3]), xi[3:]
    return out


@given(tangents())
def test_exp_is_the_matrix_exponential(xi: np.ndarray) -> None:
    # Relative to the translation. Just above the end of the series, 1 - cos loses 1e-8; this is multiplied by 1e-4 rad.
    np.testing.assert_allclose(se3.exp(xi), scipy.linalg.expm(_twist_matrix(xi)), atol=1e-10)


@given(tangents())
def test_log_inverts_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@given(tangents(), tangents(), st.floats(0, 1))
def test_the_way_between_two_poses_is_gone_evenly(start: np.ndarray, step: np.ndarray, part: float) -> None:
    T0, T1 = se3.exp(start), se3.exp(start) @ se3.exp(step)
    np.testing.assert_allclose(se3.interpolated(T0, T1, part), T0 @ se3.exp(part * step), atol=1e-8)
    several = se3.interpolated(np.stack([T0, T0]), np.stack([T1, T0]), [1.0, part])
    np.testing.assert_allclose(several, [T1, T0], atol=1e-8)


@given(arrays(np.float64, 3, elements=st.floats(-1, 1)), st.floats(0, 1e-7), st.floats(-50, 50))
def test_half_a_turn_is_no_special_case(axis: np.ndarray, less: float, t: float) -> None:
    """Where two rotation vectors are possible, both lead to the same pose; 1e-6 m of 50 m: rounding of half
    rotations."""
    assume(np.linalg.norm(axis) > 1e-3)
    T = se3.exp(np.r_[axis / np.linalg.norm(axis) * (np.pi - less), t, 1, -t])
    xi = se3.log(T)
    assert np.linalg.norm(xi[:3]) == pytest.approx(np.pi - less, abs=1e-7)
    np.testing.assert_allclose(se3.exp(xi), T, atol=1e-6)


@given(tangents())
def test_rotations_are_those_of_scipy(xi: np.ndarray) -> None:
    of_scipy = Rotation.from_rotvec(xi[:3])
    np.testing.assert_allclose(se3.rotation(xi[:3]), of_scipy.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(se3.rotation_vector(of_scipy.as_matrix()), of_scipy.as_rotvec(), atol=1e-12)
    np.testing.assert_allclose(se3.quaternion(se3.exp(xi)), of_scipy.as_quat(canonical=True), atol=1e-14)


@given(tangents(), tangents())
def test_inverse_and_product(a: np.ndarray, b: np.ndarray) -> None:
    A, B = se3.exp(a), se3.exp(b)
    np.testing.assert_allclose(se3.inverse(A) @ A, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-11)


@pytest.mark.slow
@given(tangents(), tangents(turn=0.1, reach=1.0))
def test_adjoint_moves_a_perturbation_from_right_to_left(t: np.ndarray, xi: np.ndarray) -> None:
    T = se3.exp(t)
    np.testing.assert_allclose(T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T, atol=1e-9)


@given(tangents())
def test_angle_is_exact_down_to_nothing(xi: np.ndarray) -> None:
    """The trace formula is off by 1e-8 rad near zero, a thousand times the error that a KITTI figure may have."""
    assert se3.angle(se3.exp(xi)) == pytest.approx(np.linalg.norm(xi[:3]), abs=1e-14, rel=1e-9)


@given(tangents())
def test_magnitude_is_the_same_from_either_end(xi: np.ndarray) -> None:
    """From its other end, a motion has the same length and rotation angle. The tolerance is rounding at 100 m."""
    T = se3.exp(xi)
    meters, degrees = se3.magnitude(T)
    assert degrees == pytest.approx(np.degrees(np.linalg.norm(xi[:3])), abs=1e-6)
    np.testing.assert_allclose(se3.magnitude(se3.inverse(T)), (meters, degrees), rtol=1e-9, atol=1e-9)


@given(arrays(np.float64, 3, elements=st.floats(-10, 10)), arrays(np.float64, 3, elements=st.floats(-10, 10)))
def test_hat_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(se3.hat(a) @ b, np.cross(a, b), atol=1e-13)


@given(tangents(), arrays(np.float64, (4, 4), elements=st.floats(-0.05, 0.05)))
def test_orthonormalised_gives_the_rotation_back_after_rounding(xi: np.ndarray, noise: np.ndarray) -> None:
    T = se3.exp(xi)
    noise[3] = 0
    out = se3.orthonormalized(T + noise)
    np.testing.assert_allclose(out[:3, :3] @ out[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(out[:3, :3]) == pytest.approx(1)
    assert np.abs(out - T).max() < 0.2  # three entries of 0.05 in each row, and a bit more for the polar factor
    np.testing.assert_allclose(se3.orthonormalized(T), T, atol=1e-12)


def test_orthonormalised_never_mirrors() -> None:
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    assert np.linalg.det(se3.orthonormalized(mirror)[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3), (0,)])
def test_every_function_takes_any_batch(shape: tuple[int, ...]) -> None:
    """A batch gives the same results as its members one by one."""
    xi = np.random.default_rng(0).normal(size=(*shape, 6))
    T = se3.exp(xi)
    assert T.shape == (*shape, 4, 4)
    results = (se3.inverse, (4, 4)), (se3.log, (6,)), (se3.adjoint, (6, 6)), (se3.angle, ()), (se3.quaternion, (4,))
    for function, tail in results:
        assert function(T).shape == (*shape, *tail)
        for i in np.ndindex(shape):
            np.testing.assert_allclose(function(T)[i], function(T[i]), atol=1e-14)
    assert se3.orthonormalized(T).shape == T.shape


def test_make_broadcasts_one_rotation_over_many_translations() -> None:
    T = se3.make(np.eye(3), np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(T[:, :3, 3], [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(T[:, 3], [[0, 0, 0, 1]] * 2)


def test_transform_moves_points_and_keeps_what_else_they_carry() -> None:
    points = np.array([[1, 0, 0, 0.5], [np.nan, 0, 0, 0.7]], np.float32)
    T = se3.exp([0, 0, np.pi / 2, 10, 0, 0])
    T[:3, 3] = [10, 0, 0]
    out = se3.transform(T, points)
    assert out.dtype == np.float32
    np.testing.assert_allclose(out[0], [10, 1, 0, 0.5], atol=1e-6)
    assert np.isnan(out[1, 0])
    assert out[1, 3] == np.float32(0.7)
    assert points[0, 0] == 1, "the input must stay"
    assert se3.transform(T, points[:0]).shape == (0, 4)


def test_what_is_rigid() -> None:
    """Rounding is accepted in any entry; damage, reflections and values that are not finite are rejected."""
    T = se3.exp([0.1, -2.0, 0.3, 1e5, 2, -3])
    assert se3.is_rigid(T)
    assert se3.is_rigid(T.astype(np.float32).astype(np.float64))
    for at, value in (((3, 3), 1 + 2e-15), ((0, 0), T[0, 0] + 1e-7)):
        rounded = T.copy()
        rounded[at] = value
        assert se3.is_rigid(rounded)
    for at, value in (((3, 3), 1.1), ((3, 0), 0.1), ((0, 0), T[0, 0] + 0.1), ((0, 3), np.nan), ((1, 1), np.inf)):
        bad = T.copy()
        bad[at] = value
        assert not se3.is_rigid(bad)
    assert not se3.is_rigid(np.diag([1.0, 1, -1, 1]))
