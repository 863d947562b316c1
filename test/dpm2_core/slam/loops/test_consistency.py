# SPDX-License-Identifier: Apache-2.0
"""A loop passes when the odometry or a second loop agrees, waits while none does, and is rejected beyond all drift."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.consistency import Consistency, ConsistencySettings, OdometryChain

FIRM, LOST = np.diag([np.radians(0.15)] * 3 + [0.05] * 3) ** 2, np.eye(6)  # of 5 m, as keyframes have it


def pose(x: float, y: float = 0.0, yaw: float = 0.0) -> Array:
    return se3.exp(np.array([0, 0, 0, x, y, 0])) @ se3.exp(np.array([0, 0, yaw, 0, 0, 0]))


BENT = pose(0, 0, np.radians(0.7))
"""What the odometry may well err by in 500 m: 6 m across at the end."""


def keyframe(node: int, T: Array, covariance: Array | None = FIRM, robot: str = "") -> Keyframe:
    edge = None if covariance is None else Registration(np.eye(4), covariance, 1.0, 0.1, "test")
    return Keyframe(node, node, node, T, np.zeros((0, 4), np.float32), edge, robot)


def straight(count: int = 101, step: float = 5.0) -> OdometryChain:
    """A drive straight on, 500 m long."""
    path = OdometryChain()
    for node in range(count):
        path.append(keyframe(node, pose(step * node), None if node == 0 else FIRM))
    return path


def loop(a: int, b: int, T: Array) -> Edge:
    return Edge("loop", a, b, Registration(T, FIRM, 0.9, 0.1, "test"))


def expected(path: OdometryChain, a: int, b: int) -> Array:
    return path.T(a, b)


def checked_by(consistency: Consistency, candidate: Edge, T_expected: np.ndarray) -> list[Edge]:
    return consistency.check(candidate, T_expected, ConsistencySettings())


def test_path_lengths_are_known_within_a_segment_alone() -> None:
    path = OdometryChain()
    nodes = [("a", None), ("a", FIRM), ("b", None), ("a", FIRM), ("b", FIRM), ("a", LOST), ("a", FIRM)]
    for node, (robot, covariance) in enumerate(nodes):
        path.append(keyframe(node, pose(3.0 * node), covariance, robot))
    np.testing.assert_array_equal(path.since(3), [9, 6, np.inf, 0, np.inf, np.inf, np.inf])
    assert path.between(2, 4) == 6
    assert path.between(5, 6) == 3
    assert path.between(3, 5) == np.inf  # the odometry was lost between them


@pytest.mark.parametrize(("sigma", "turn", "known"), [(1.0, 1e-3, True), (20.0, 1e-3, False), (1.0, 0.3, False)])
def test_a_stretch_that_is_uncertain_by_less_than_the_drift_does_not_part_a_long_drive(
    sigma: float, turn: float, known: bool
) -> None:
    # four keyframes whose scans leave the direction of the road open, in a drive of 1 km: 12 m of the 21 that may drift
    path, uncertain = OdometryChain(), np.diag([turn**2] * 3 + [sigma**2, 1e-4, 1e-4])
    for node in range(201):
        path.append(keyframe(node, pose(5.0 * node), None if node == 0 else uncertain if 100 <= node < 104 else FIRM))
    assert path.between(0, 200) == (1000 if known else np.inf)
    assert path.since(200)[0] == path.between(0, 200)
    assert path.between(90, 110) == np.inf  # 100 m of path may drift by 3 m: what lies on both sides is not known
    assert path.between(0, 99) == 495
    assert path.between(104, 200) == 480
    assert Consistency(path).is_first(loop(0, 200, np.eye(4)), ConsistencySettings()) is not known


def test_a_loop_that_agrees_with_the_odometry_needs_no_other() -> None:
    path = straight()
    T = expected(path, 0, 100)
    (checked,) = checked_by(Consistency(path), loop(0, 100, T @ pose(1.5)), T)
    assert checked.ok


def test_a_loop_beyond_all_drift_is_rejected() -> None:
    path = straight()
    consistency = Consistency(path)
    T = expected(path, 0, 100)
    for off in (pose(12.0), pose(0, 0, np.radians(14))):  # 500 m of path allow 11 m and 13 degrees
        (checked,) = checked_by(consistency, loop(0, 100, T @ off), T)
        assert not checked.ok
        assert "from the odometry" in checked.registration.reason
    # what was rejected confirms nothing
    (checked,) = checked_by(consistency, loop(1, 99, expected(path, 1, 99) @ pose(11.9)), expected(path, 1, 99))
    assert not checked.ok


def test_two_loops_that_agree_are_accepted_together() -> None:
    path, drift = straight(), BENT
    consistency = Consistency(path)
    first = loop(0, 99, drift @ expected(path, 0, 99))
    (waiting,) = checked_by(consistency, first, expected(path, 0, 99))
    assert not waiting.ok
    assert "waits" in waiting.registration.reason
    accepted = checked_by(consistency, loop(1, 100, drift @ expected(path, 1, 100)), expected(path, 1, 100))
    assert [(a.from_node, a.to_node) for a in accepted] == [(1, 100), (0, 99)]
    assert all(a.ok for a in accepted)
    # a third one finds the two accepted, and none is accepted twice
    third = checked_by(consistency, loop(2, 98, drift @ expected(path, 2, 98)), expected(path, 2, 98))
    assert [(a.from_node, a.to_node) for a in third] == [(2, 98)]


@pytest.mark.parametrize(
    ("a", "b", "off"),
    [(1, 100, se3.inverse(BENT)), (1, 99, BENT), (40, 100, BENT)],
    ids=["another correction", "the same keyframe", "another place"],
)
def test_a_loop_is_not_confirmed_by(a: int, b: int, off: Array) -> None:
    path = straight()
    consistency = Consistency(path)
    checked_by(consistency, loop(0, 99, BENT @ expected(path, 0, 99)), expected(path, 0, 99))
    (checked,) = checked_by(consistency, loop(a, b, off @ expected(path, a, b)), expected(path, a, b))
    assert "waits" in checked.registration.reason


def test_storeys_that_look_alike_are_not_joined() -> None:
    """A lap of 100 m that climbs by 2.8 m: less than the drift of 2 % and 1 m, and all loops to the storey below agree;
    but so much is many times what such an odometry errs by."""
    path, lap = OdometryChain(), 20
    height = lambda node: 2.8 * min(node / lap, 1)  # noqa: E731
    for node in range(lap + 4):
        turn = 2 * np.pi * node / lap
        T = se3.exp(np.array([0, 0, 0, 16 * np.sin(turn), -16 * np.cos(turn), height(node)]))
        path.append(keyframe(node, T @ se3.exp(np.array([0, 0, turn, 0, 0, 0])), None if node == 0 else FIRM))
    consistency = Consistency(path)
    for node in range(lap, lap + 4):
        T = path.T(node - lap, node)
        T_alike = T.copy()
        T_alike[2, 3] = 0.0
        (checked,) = checked_by(consistency, loop(node - lap, node, T_alike), T)
        assert "standard deviations from the odometry" in checked.registration.reason


def test_between_robots_it_always_takes_two() -> None:
    """Nothing is known of where they are to each other, however well a first loop happens to fit the map."""
    path = OdometryChain()
    for node in range(40):
        robot = "a" if node < 20 else "b"
        path.append(keyframe(node, pose(5.0 * (node % 20)), None if node % 20 == 0 else FIRM, robot))
    consistency = Consistency(path)
    T = pose(0.5)
    (first,) = checked_by(consistency, loop(3, 23, T), np.eye(4))
    assert not first.ok
    assert len(checked_by(consistency, loop(4, 24, T), np.eye(4))) == 2


def test_a_loop_is_the_first_where_neither_odometry_nor_another_loop_ties_its_ends() -> None:
    path, settings, T = straight(), ConsistencySettings(), pose(0.5)
    consistency = Consistency(path)
    assert not consistency.is_first(loop(10, 40, pose(3.0) @ expected(path, 10, 40)), settings)
    for node in range(101, 121):
        path.append(keyframe(node, pose(5.0 * (node - 101)), None if node == 101 else FIRM, "b"))
    assert consistency.is_first(loop(3, 104, T), settings)
    consistency.check(loop(3, 104, T), np.eye(4), settings)
    assert consistency.is_first(loop(4, 105, T), settings)  # the other one still waits
    consistency.check(loop(4, 105, T), np.eye(4), settings)
    assert not consistency.is_first(loop(5, 106, T), settings)
    assert consistency.is_first(loop(5, 106, pose(9.0)), settings)
