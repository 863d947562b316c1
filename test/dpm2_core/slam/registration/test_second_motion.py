# SPDX-License-Identifier: Apache-2.0
"""If many points move with the robot, two motions may be its own. The odometry reports this, and how far apart they
are."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.estimates import OdometryResult, State
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import SlamSettings

from ....helpers import rooms

HALL = np.array([[-8.0, -8, 0], [8, 8, 4]])
SHELVES = rooms.boxes((-7, -7.8), (7, 7.3), 60, np.array([0.6, 0.5, 1.5]))
STEP = 0.1  # m per frame
COUNT = 15


def crowd(count: int) -> Array:
    """Boxes (count, 2, 3) as large as people, 0.9 to 5 m around the origin."""
    rng = np.random.default_rng(count)
    radius, angle = np.sqrt(rng.uniform(0.9**2, 5.0**2, count)), rng.uniform(-np.pi, np.pi, count)
    low = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)]) - [0.2, 0.2, 0]
    return np.stack([low, low + np.array([0.4, 0.4, 1.75])], 1)


def driven(people: int, along: bool = True) -> tuple[list[OdometryResult], Array]:
    """A robot drives through a hall among people who walk with it, or stand. Returns its odometry and the position
    errors, m."""
    way = STEP * np.arange(COUNT)[:, None] * [1.0, 0, 0]
    truth = se3.make(np.eye(3), way + np.array([0, 0, 0.6]))
    odometry = make_odometry(SlamSettings())
    results = []
    for i, T in enumerate(truth):
        around = crowd(people) + along * way[i]
        cloud = rooms.scan(T, HALL, np.concatenate([SHELVES, around]), i)
        results.append(odometry.process(Frame(i * 10**8, cloud, index=i)))
    off = se3.inverse(se3.inverse(truth[0]) @ truth) @ np.array([r.T_odom_lidar for r in results])
    return results, np.linalg.norm(off[:, :3, 3], axis=1)


def test_a_crowd_that_hides_the_walls_is_followed_and_the_way_to_them_stated() -> None:
    """Most of what it sees stands still relative to it. Only the reported uncertainty shows that the robot drives."""
    results, errors = driven(60)
    assert errors[-1] > 0.9 * STEP * (COUNT - 1), "else it is not the crowd that is followed"
    for result, error in zip(results[4:], errors[4:], strict=True):
        assert result.state is State.DEGRADED
        # to centimeters; if the walls are too far off to be matched, the motion is extrapolated
        assert result.registration.worst_sigma == pytest.approx(error, rel=0.1)
        assert "fit another motion" in result.registration.reason


@pytest.mark.parametrize(("people", "along"), [(30, True), (60, False)])
def test_where_the_walls_are_followed_there_is_no_doubt(people: int, along: bool) -> None:
    """This is so although with 16 beams many points have the same distance wherever the robot is."""
    results, errors = driven(people, along)
    assert errors.max() < 0.05
    assert {r.state for r in results[2:]} == {State.TRACKING}
