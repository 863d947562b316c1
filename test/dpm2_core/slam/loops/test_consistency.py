# SPDX-License-Identifier: Apache-2.0
"""A loop is accepted if the odometry or a second loop agrees. It waits as long as none does, and is rejected beyond all
drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from dpm2_core.estimates import Edge, Keyframe, Registration, isotropic
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.loops.consistency import Consistency, ConsistencySettings, OdometryChain

FIRM, LOST = isotropic(np.radians(0.15), 0.05), np.eye(6)  # per 5 m, as for keyframes


def pose(x: float, y: float = 0.0, yaw: float = 0.0) -> Array:
    return se3.exp(np.array([0, 0, 0, x, y, 0])) @ se3.exp(np.array([0, 0, yaw, 0, 0, 0]))


BENT = pose(0, 0, np.radians(0.7))
"""Plausible error of the odometry over 500 m: 6 m sideways at the end."""


def keyframe(node: int, T: Array, covariance: Array | None = FIRM, robot: str = "") -> Keyframe:
    edge = None if covariance is None else Registration(np.eye(4), covariance, 1.0, 0.1, "test")
    return Keyframe(node, node, node, T, np.zeros((0, 4), np.float32), edge, robot)


def straight(count: int = 101, step: float = 5.0) -> OdometryChain:
    """A straight drive of 500 m."""
    path = OdometryChain()
    for node in range(count):
        path.append(keyframe(node, pose(step * node), None if node == 0 else FIRM))
    return path


def loop(a: int, b: int, T: Array) -> Edge:
    return Edge("loop", a, b, Registration(T, FIRM, 0.9, 0.1, "test"))


def expected(path: OdometryChain, a: int, b: int) -> Array:
    return path.T(a, b)


def knowing(path: OdometryChain, parts: Sequence[int] | None = None) -> Consistency:
    """Consistency with a map of all nodes, in one part or in `parts`. Its poses are the odometry from the first
    node."""
    consistency = Consistency(path)
    poses = np.array([path.T(0, node) for node in range(len(path))])
    consistency.update(poses, np.zeros(len(path), np.intp) if parts is None else np.array(parts))
    return consistency


def checked_by(consistency: Consistency, candidate: Edge) -> list[Edge]:
    return consistency.check(candidate, ConsistencySettings())


def test_path_lengths_are_known_within_a_segment_alone() -> None:
    path = OdometryChain()
    nodes = [("a", None), ("a", FIRM), ("b", None), ("a", FIRM), ("b", FIRM), ("a", LOST), ("a", FIRM)]
    for node, (robot, covariance) in enumerate(nodes):
        path.append(keyframe(node, pose(3.0 * node), covariance, robot))
    np.testing.assert_array_equal(path.since(3), [9, 6, np.inf, 0, np.inf, np.inf, np.inf])
    assert path.between(2, 4) == 6
    assert path.between(5, 6) == 3
    assert path.between(3, 5) == np.inf  # the odometry was lost between these nodes


@pytest.mark.parametrize(("sigma", "turn", "known"), [(1.0, 1e-3, True), (20.0, 1e-3, False), (1.0, 0.3, False)])
def test_a_stretch_that_is_uncertain_by_less_than_the_drift_does_not_part_a_long_drive(
    sigma: float, turn: float, known: bool
) -> None:
    # Four keyframes whose scans leave the direction of the road open, in a drive of 1 km: 12 m, where a drift of 21 m
    # is allowed.
    path, uncertain = OdometryChain(), np.diag([turn**2] * 3 + [sigma**2, 1e-4, 1e-4])
    for node in range(201):
        path.append(keyframe(node, pose(5.0 * node), None if node == 0 else uncertain if 100 <= node < 104 else FIRM))
    assert path.between(0, 200) == (1000 if known else np.inf)
    assert path.since(200)[0] == path.between(0, 200)
    assert path.between(90, 110) == np.inf  # 100 m of path may drift by 3 m, so the two sides are not connected
    assert path.between(0, 99) == 495
    assert path.between(104, 200) == 480
    assert knowing(path).is_first(loop(0, 200, np.eye(4)), ConsistencySettings()) is not known


def test_a_loop_that_agrees_with_the_odometry_needs_no_other() -> None:
    path = straight()
    T = expected(path, 0, 100)
    (checked,) = checked_by(knowing(path), loop(0, 100, T @ pose(1.5)))
    assert checked.ok


def test_a_loop_beyond_all_drift_is_rejected() -> None:
    path = straight()
    consistency = knowing(path)
    T = expected(path, 0, 100)
    for off in (pose(12.0), pose(0, 0, np.radians(14))):  # 500 m of path allow 11 m and 13 degrees
        (checked,) = checked_by(consistency, loop(0, 100, T @ off))
        assert not checked.ok
        assert "from the odometry" in checked.registration.reason
    # A rejected loop confirms nothing.
    (checked,) = checked_by(consistency, loop(1, 99, expected(path, 1, 99) @ pose(11.9)))
    assert not checked.ok


def test_two_loops_that_agree_are_accepted_together() -> None:
    path, drift = straight(), BENT
    consistency = knowing(path)
    first = loop(0, 99, drift @ expected(path, 0, 99))
    (waiting,) = checked_by(consistency, first)
    assert not waiting.ok
    assert "waits" in waiting.registration.reason
    accepted = checked_by(consistency, loop(1, 100, drift @ expected(path, 1, 100)))
    assert [(a.from_node, a.to_node) for a in accepted] == [(1, 100), (0, 99)]
    assert all(a.ok for a in accepted)
    # A third loop agrees with the two accepted ones, and none is accepted twice.
    third = checked_by(consistency, loop(2, 98, drift @ expected(path, 2, 98)))
    assert [(a.from_node, a.to_node) for a in third] == [(2, 98)]


@pytest.mark.parametrize(
    ("a", "b", "off"),
    [(1, 100, se3.inverse(BENT)), (1, 99, BENT), (40, 100, BENT)],
    ids=["another correction", "the same keyframe", "another place"],
)
def test_a_loop_is_not_confirmed_by(a: int, b: int, off: Array) -> None:
    path = straight()
    consistency = knowing(path)
    checked_by(consistency, loop(0, 99, BENT @ expected(path, 0, 99)))
    (checked,) = checked_by(consistency, loop(a, b, off @ expected(path, a, b)))
    assert "waits" in checked.registration.reason


def test_storeys_that_look_alike_are_not_joined() -> None:
    """A lap of 100 m that climbs by 2.8 m. This is less than the drift of 2 % and 1 m, and all loops to the storey
    below agree. But it is many times the error of such an odometry."""
    path, lap = OdometryChain(), 20
    height = lambda node: 2.8 * min(node / lap, 1)  # noqa: E731
    for node in range(lap + 4):
        turn = 2 * np.pi * node / lap
        T = se3.exp(np.array([0, 0, 0, 16 * np.sin(turn), -16 * np.cos(turn), height(node)]))
        path.append(keyframe(node, T @ se3.exp(np.array([0, 0, turn, 0, 0, 0])), None if node == 0 else FIRM))
    consistency = knowing(path)
    for node in range(lap, lap + 4):
        T = path.T(node - lap, node)
        T_alike = T.copy()
        T_alike[2, 3] = 0.0
        (checked,) = checked_by(consistency, loop(node - lap, node, T_alike))
        assert "standard deviations from the odometry" in checked.registration.reason


def drives(names: str) -> OdometryChain:
    """Drives of robots, each with 20 keyframes straight ahead in a frame of its own."""
    path = OdometryChain()
    for robot in names:
        for node in range(20):
            path.append(keyframe(node, pose(5.0 * node), FIRM if node else None, robot))
    return path


def test_between_robots_it_always_takes_two() -> None:
    """Their relative pose is not known, however well a first loop happens to fit the map."""
    consistency = knowing(drives("ab"), [0] * 20 + [1] * 20)
    T = pose(0.5)
    (first,) = checked_by(consistency, loop(3, 23, T))
    assert not first.ok
    assert len(checked_by(consistency, loop(4, 24, T))) == 2


@pytest.mark.parametrize(
    ("parts", "off", "agree"),
    [("001", 0.0, True), ("012", 0.0, False), ("001", 3.0, False)],
    ids=["tied", "not tied", "elsewhere"],
)
def test_loops_to_drives_that_others_have_tied_agree_through_the_map(parts: str, off: float, agree: bool) -> None:
    """As in a place with many short drives, where each loop may lead to a different drive."""
    consistency = knowing(drives("abc"), np.repeat([int(part) for part in parts], 20).tolist())
    ahead = 12.0  # the third drive began 12 m along the first two
    (first,) = checked_by(consistency, loop(3, 41, pose(ahead + 5.0 - 15.0)))
    assert not first.ok
    found = checked_by(consistency, loop(26, 43, pose(ahead + 15.0 - 30.0 + off)))
    assert [one.ok for one in found] == ([True, True] if agree else [False])


def test_loops_of_drives_that_are_tied_agree_through_the_map() -> None:
    """The first loop waits. A loop of another drive, which begins next to it, agrees, and together they are
    accepted."""
    consistency = knowing(drives("abc"), [0] * 20 + [1] * 40)
    (first,) = checked_by(consistency, loop(3, 22, pose(12.0 + 10.0 - 15.0)))
    assert not first.ok
    assert len(checked_by(consistency, loop(4, 43, pose(12.0 + 15.0 - 20.0)))) == 2


def test_a_loop_is_the_first_where_neither_odometry_nor_another_loop_ties_its_ends() -> None:
    path, settings, T = drives("ab"), ConsistencySettings(), pose(0.5)
    consistency = knowing(path, [0] * 20 + [1] * 20)
    assert not consistency.is_first(loop(2, 18, pose(3.0) @ expected(path, 2, 18)), settings)
    assert consistency.is_first(loop(3, 23, T), settings)
    consistency.check(loop(3, 23, T), settings)
    assert consistency.is_first(loop(4, 24, T), settings)  # the first loop is still waiting
    consistency.check(loop(4, 24, T), settings)
    assert not consistency.is_first(loop(5, 25, T), settings)
    assert consistency.is_first(loop(5, 25, pose(9.0)), settings)


def test_a_loop_does_not_wait_forever() -> None:
    """Previously, all unconfirmed loops were kept, as for two drives in places that look alike. Each search took
    longer: 22 ms with 1000 waiting loops. A loop is still confirmed after 199 later ones, but not after 200."""
    path = drives("ab")
    for waits in (199, 200):
        consistency, rng = knowing(path, [0] * 20 + [1] * 20), np.random.default_rng(0)
        checked_by(consistency, loop(3, 23, pose(0.5)))
        for number in range(waits):  # each disagrees with the others, 20 to 220 m away
            checked_by(consistency, loop(5, 25, pose(20.0 + number, rng.uniform(-50, 50))))
        assert len(checked_by(consistency, loop(4, 24, pose(0.5)))) == (2 if waits == 199 else 1)
