# SPDX-License-Identifier: Apache-2.0
"""Descriptors of a tilted sensor keep their positions and level axes under any motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from dpm2_core.descriptors import Descriptors, LazyDescriptors, levelling, merge
from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

LEAN = se3.exp([0.1, 0.5, 0, 0, 0, 0])  # 29 degrees


def level(noise: np.random.Generator) -> Descriptors:
    """Descriptors as a level sensor has them."""
    return Descriptors.of(noise.normal(size=(30, 3)).astype("f4") * 20, noise.normal(size=(30, 8)))


def leaning(d: Descriptors, R: Array) -> Descriptors:
    """The same descriptors from a sensor in whose frame the level axes are rotated by R (3, 3)."""
    return replace(d, xyz=(d.xyz @ R.T).astype("f4"), up=R[:, 2].astype("f4"))


@pytest.mark.parametrize("up", [[0, 0, 1], [0.6, 0, 0.8], [-0.3, 0.4, 0.75**0.5]])
def test_levelling_is_the_smallest_turn_that_brings_up_to_z(up: list[float]) -> None:
    R = levelling(np.array(up)).astype(float)
    np.testing.assert_allclose(R @ up, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert np.arccos((np.trace(R) - 1) / 2) == pytest.approx(np.arccos(up[2]), abs=1e-3)


@pytest.mark.parametrize("up", [[0, 0, -1], [3e-8, -1e-8, -1], [0.6, 0, -0.8]])
def test_what_points_down_is_turned_over_about_x_first(up: list[float]) -> None:
    """For a sensor that points straight down, the heading must not depend on rounding."""
    R = levelling(np.array(up)).astype(float)
    np.testing.assert_allclose(R @ up, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(R, levelling(np.array(up) * [1, -1, -1]) @ np.diag([1, -1, -1]), atol=1e-6)


def test_the_heights_of_a_tilted_set_are_those_of_a_level_one(noise: np.random.Generator) -> None:
    plain = level(noise)
    again = leaning(plain, LEAN[:3, :3]).as_encoded()
    np.testing.assert_allclose(again.xyz[:, 2], plain.xyz[:, 2], atol=1e-5)
    assert plain.as_encoded() is plain


def test_axes_point_to_the_descriptors_after_any_move(noise: np.random.Generator) -> None:
    T = se3.exp([0.05, -0.04, 2.5, 3, 4, 1])
    plain = level(noise)
    moved = leaning(plain, LEAN[:3, :3]).moved(LEAN @ T @ se3.inverse(LEAN))
    at = moved.R_level_set.astype(float)
    origin = at @ LEAN[:3, :3] @ T[:3, 3]  # position of the sensor that saw them
    seen = moved.as_encoded().xyz[:, :2] - origin[:2]
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(moved.axes, axis=1), 1, atol=1e-5)
    # T itself leans by 4 degrees: points high up appear next to their vertical projection.
    low = np.abs(plain.xyz[:, 2]) < np.linalg.norm(plain.xyz[:, :2], axis=1)
    assert (np.einsum("ij,ij->i", seen, moved.axes)[low] > 0.98).all()


@pytest.mark.parametrize("lean", [LEAN, se3.exp([np.pi, 0, 0, 0, 0, 0]), se3.exp([3.0, 0.2, 0.5, 0, 0, 0])])
def test_in_a_level_base_they_are_those_of_a_level_sensor(noise: np.random.Generator, lean: Array) -> None:
    """This includes a sensor that is mounted upside down."""
    plain = level(noise)
    base = leaning(plain, lean[:3, :3]).moved(se3.inverse(lean))
    assert base.up is None
    np.testing.assert_allclose(base.xyz, plain.xyz, atol=1e-4)
    np.testing.assert_allclose(base.axes, plain.axes, atol=1e-4)


def test_merged_sets_have_one_way_up(noise: np.random.Generator) -> None:
    """Each set has estimated its own up direction."""
    plain = level(noise)
    one = leaning(plain, LEAN[:3, :3])
    wobble = se3.exp([0.01, -0.02, 0, 0, 0, 0])[:3, :3].astype("f4")
    other = replace(one, up=wobble @ one.up)
    both = merge([one, other])
    assert both.up is not None
    np.testing.assert_array_equal(both.up, one.up)
    low = np.abs(plain.xyz[:, 2]) < np.linalg.norm(plain.xyz[:, :2], axis=1)
    np.testing.assert_allclose(both.axes[30:][low], both.axes[:30][low], atol=0.05)  # twice the 0.02 rad at 45 degrees
    np.testing.assert_allclose(both.axes[:30], one.axes, atol=1e-5)


@given(arrays(np.float32, (3, 5), elements=st.floats(-1e4, 1e4, width=32)))
def test_features_are_rounded_to_a_254th_of_the_largest(values: NDArray[np.float32]) -> None:
    """The rounding is per descriptor, and applying it again changes nothing."""
    d = Descriptors.of(np.zeros((3, 3), np.float32), values)
    largest = np.abs(values).max(1, keepdims=True)
    assert (np.abs(d.values - values) <= largest / 254 * 1.001 + 1e-30).all()
    np.testing.assert_array_equal(
        Descriptors.of(d.xyz, d.values).features[largest[:, 0] > 1e-20], d.features[largest[:, 0] > 1e-20]
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_features_that_are_not_finite_have_a_step_that_is_not(value: float) -> None:
    values = np.ones((3, 5), np.float32)
    values[1, 2] = value
    assert np.isfinite(Descriptors.of(np.zeros((3, 3), np.float32), values).step).tolist() == [True, False, True]


def test_lazy_descriptors_are_made_once_and_say_why_there_are_none(noise: np.random.Generator) -> None:
    asked = []

    def fails() -> Descriptors:
        asked.append(1)
        raise Dpm2Error("scan has 3 points")

    lazy = LazyDescriptors(fails)
    assert (lazy.made, lazy.problem, asked) == (False, "", [])
    assert lazy.get() is None
    assert lazy.get() is None
    assert (lazy.made, lazy.problem, asked) == (True, "scan has 3 points", [1])
    some = level(noise)
    found = LazyDescriptors(lambda: some)
    assert found.get() is some
    assert found.problem == ""


def test_a_room_is_enlarged_for_the_network_alone(noise: np.random.Generator) -> None:
    """The positions of descriptors are always in meters; the scale is kept under any motion."""
    room = replace(level(noise), scale=5.0)
    np.testing.assert_allclose(room.as_encoded().xyz, 5 * room.xyz, rtol=1e-6)
    np.testing.assert_allclose(room.axes, replace(room, scale=1.0).axes, atol=1e-6)
    moved = room.moved(LEAN)
    assert moved.scale == 5
    np.testing.assert_allclose(moved.xyz, se3.transform(LEAN, room.xyz), atol=1e-5)
    both = merge([room, moved])
    assert (len(both), both.scale) == (60, 5)


def test_what_was_enlarged_by_another_factor_is_not_merged(noise: np.random.Generator) -> None:
    room, street = replace(level(noise), scale=5.0), level(noise)
    for first, other in ((room, street), (street, room)):
        merged = merge([first, other, first])
        assert (len(merged), merged.scale) == (60, first.scale)
