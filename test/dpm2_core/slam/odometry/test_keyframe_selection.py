# SPDX-License-Identifier: Apache-2.0
"""Keyframes by motion, or, as in DeepPointMap, by how well scans register."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.estimates import Registration
from dpm2_core.frame import Fix, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSelector, KeyframeSettings
from dpm2_core.slam.preprocess import Scan


def places(settings: KeyframeSettings, rmse: float, meters: int = 120) -> list[float]:
    """Positions of the keyframes along a straight line with a scan per meter."""
    selector, scan, out = KeyframeSelector(settings), Scan(np.zeros((5, 4), np.float32)), []
    for x in range(meters):
        T = se3.make(np.eye(3), [float(x), 0, 0])
        if selector.select(Frame(x, scan.points), scan, T, Registration(T, np.eye(6) * 1e-4, 1.0, rmse, "test")):
            out.append(float(x))
    return out


def test_by_motion_the_residual_has_no_say() -> None:
    assert places(KeyframeSettings(distance=10), 0.0) == places(KeyframeSettings(distance=10), 0.9)
    assert np.unique(np.diff(places(KeyframeSettings(distance=10), 0.1))).tolist() == [10.0]


@pytest.mark.parametrize(("rmse", "spacing"), [(0.0, 20.0), (0.146, 10.0), (0.5, 1.0), (np.inf, 1.0)])
def test_by_the_residual_the_spacing_settles(rmse: float, spacing: float) -> None:
    """The spacing is 2 (1 - rmse / 0.5)^2 of the distance, but at least 1 m."""
    at = places(KeyframeSettings(distance=10, residual=0.5), rmse)
    assert np.diff(at)[-3:] == pytest.approx(spacing, abs=1.01)  # a scan per meter


def turning(steps: list[tuple[float, float]], broken: int | None = None) -> list[int]:
    """Indices of the steps (m ahead, degrees of heading) at which a keyframe is made; a step is the robot's pose.

    `broken`: the step before which the odometry broke.
    """
    selector, scan, out = KeyframeSelector(KeyframeSettings()), Scan(np.zeros((5, 4), np.float32)), []
    for n, (x, heading) in enumerate(steps):
        if n == broken:
            selector.add_uncertainty(np.eye(6))
        T = se3.make(se3.rotation(np.array([0, 0, np.radians(heading)])), [x, 0, 0])
        if selector.select(Frame(n, scan.points), scan, T, Registration(T, np.eye(6) * 1e-4)):
            out.append(n)
    return out


def test_a_robot_that_turns_on_the_spot_makes_the_keyframes_of_one_turn() -> None:
    """Otherwise each further rotation of a LiDAR on a turntable, or of a robot that looks around, would add another
    map. 30 degrees are more than the angle in the settings. After the robot was away, or the odometry broke, new
    keyframes are made."""
    turn = [(0.0, 30.0 * step) for step in range(12)]
    assert turning(turn * 5) == list(range(12))
    to_and_fro = [(0.0, 0.0), (0.0, 30.0)] * 20
    assert turning(to_and_fro) == [0, 1]
    assert turning([*turn, (6.0, 0.0), *turn]) == list(range(25))
    assert turning([*to_and_fro, *to_and_fro], broken=len(to_and_fro)) == [0, 1, 40]


def test_keyframes_that_are_requested_at_a_halt_cost_no_later_frame_time() -> None:
    """A robot that is not localized requests one keyframe per second, all night. Previously, a frame took 0.1 s after
    90 minutes, all the time available. The test counts pose comparisons, because times vary."""
    selector, scan, compared = KeyframeSelector(KeyframeSettings()), Scan(np.zeros((5, 4), np.float32)), [0]

    class Counted(np.ndarray):
        def __rmatmul__(self, other: object) -> object:
            compared[0] += 1
            return np.asarray(other) @ np.asarray(self)

    def select(x: float, heading: float, T_of: type[np.ndarray] = np.ndarray) -> bool:
        T = se3.make(se3.rotation(np.array([0, 0, np.radians(heading)])), [x, 0, 0])
        return selector.select(Frame(0, scan.points), scan, T.view(T_of), Registration(T, np.eye(6) * 1e-4)) is not None

    for n in range(200):
        selector.request()
        assert select(0.01 * (n % 2), 90.0 * (n % 4))
    assert not select(0.0, 0.0, Counted)
    assert 0 < compared[0] <= 4  # one per heading
    assert [select(x, 0.0) for x in (4.0, 6.0, 10.0, 11.5)] == [False, True, False, True]


def test_an_edge_is_no_firmer_than_a_registration_on_its_way() -> None:
    """Scans that leave a direction open for a while are added to the map. The next scan fits them, but has no more
    information."""
    selector, scan = KeyframeSelector(KeyframeSettings(distance=5)), Scan(np.zeros((5, 4), np.float32))
    worst = []
    for meter in range(16):
        sigma = 1.0 if meter in (2, 7) else 0.02
        T = se3.make(np.eye(3), [float(meter), 0, 0])
        registration = Registration(T, np.diag([1e-6] * 3 + [sigma**2, 1e-4, 1e-4]))
        keyframe = selector.select(Frame(meter, scan.points), scan, T, registration)
        if keyframe is not None and keyframe.edge is not None:
            worst.append(keyframe.edge.worst_sigma)
    assert worst == pytest.approx([1.0, 1.0, 0.05], abs=0.01)  # the last one: 1 % of 5 m, and 0.02 m


def test_an_edge_is_as_uncertain_as_the_way_that_scenes_have_left_open() -> None:
    """0.5 m in each of five steps are 2.5 m, because the velocity is not known. The next edge starts anew."""
    selector, scan = KeyframeSelector(KeyframeSettings(distance=5)), Scan(np.zeros((5, 4), np.float32))
    edges = []
    for meter in range(11):
        T = se3.make(np.eye(3), [float(meter), 0, 0])
        selector.leave_open(np.diag([0.25, 0, 0]) * (1 <= meter <= 5))
        keyframe = selector.select(Frame(meter, scan.points), scan, T, Registration(T, np.eye(6) * 1e-4))
        if keyframe is not None and keyframe.edge is not None:
            edges.append(np.sqrt(np.diag(keyframe.edge.covariance)[3:]))
    assert edges[0] == pytest.approx([2.5, 0.05, 0.05], abs=0.01)
    assert edges[1] == pytest.approx([0.05, 0.05, 0.05], abs=0.01)


def fixes_on_the_way(fixes: dict[int, Fix], failed: int | None = None, start: float = 0.0) -> dict[int, Fix]:
    """Fixes of keyframes, by their frame. The robot moves forward at 1 m/s, rotated by 90 degrees to the left.

    `fixes`: by the frame with which they arrive. `failed`: a frame that is not registered. `start`: start position
    along the path, m.
    """
    selector, scan, out = KeyframeSelector(KeyframeSettings(distance=5)), Scan(np.zeros((5, 4), np.float32)), {}
    for second in range(13):
        T = se3.make(se3.rotation(np.array([0, 0, np.pi / 2])), [0.0, start + second, 0.0])
        frame = Frame(second * 10**9, scan.points, fix=fixes.get(second))
        registration = Registration(T, np.eye(6) * 1e-4, ok=second != failed)
        keyframe = selector.select(frame, scan, T, registration)
        if keyframe is not None and keyframe.fix is not None:
            out[second] = keyframe.fix
    return out


def measured(seconds: float) -> Fix:
    return Fix(round(seconds * 1e9), np.array([49.0, 8.4, seconds]), np.eye(3), np.array([0.0, 0.0, 1.5]))


def test_a_fix_travels_with_the_next_keyframe_as_seen_from_there() -> None:
    """It arrives late. The antenna position is that at the time of the fix, between two scans."""
    found = fixes_on_the_way({2: measured(0.5), 4: measured(3.25), 9: measured(9.0)})
    assert list(found) == [5, 10]  # 5 m apart
    assert found[5].stamp == 3_250_000_000  # the later of the two
    np.testing.assert_allclose(found[5].antenna, [-1.75, 0, 1.5], atol=1e-9)  # behind the keyframe
    np.testing.assert_allclose(found[10].antenna, [-1.0, 0, 1.5], atol=1e-9)


def test_far_from_the_start_of_the_drive_fixes_are_taken_as_near_it() -> None:
    """Previously, antenna positions were in the odometry frame, where one beyond 1 km was rejected: the frame was an
    error."""
    near, far = (fixes_on_the_way({4: measured(3.25)}, start=start)[5] for start in (0.0, 5000.0))
    np.testing.assert_allclose(far.antenna, near.antenna, atol=1e-9)  # 1e-12 m is the last digit of 5 km


def test_a_fix_without_a_known_way_is_left_out() -> None:
    assert fixes_on_the_way({2: measured(-0.5)}) == {}  # from before the drive
    assert fixes_on_the_way({2: measured(2.5)}) == {}  # in the future
    assert fixes_on_the_way({2: measured(1.5)}, failed=3) == {}
    assert fixes_on_the_way({4: measured(1.5)}, failed=3) == {}
