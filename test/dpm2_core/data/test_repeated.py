# SPDX-License-Identifier: Apache-2.0
"""Clouds that are published again, completely or in part."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.data.repeated import RepeatedCloud, RepeatedPart
from dpm2_core.frame import Frame, Points
from dpm2_core.geometry import se3


def cloud(rng: np.random.Generator, count: int = 30_000) -> Points:
    return rng.uniform(-40, 40, (count, 4)).astype(np.float32)


def kept(*clouds: Points) -> int:
    """Number of points of the last cloud that are kept."""
    part = RepeatedPart()
    return [len(part.new(Frame(index, points)).points) for index, points in enumerate(clouds)][-1]


@pytest.mark.parametrize("share", [0.35, 0.5, 0.65])
def test_what_is_that_of_before_is_left_out_with_its_times(noise: np.random.Generator, share: float) -> None:
    again, part = cloud(noise)[: round(30_000 * share)], RepeatedPart()
    times = np.linspace(0, 0.1, 30_000, dtype=np.float32)
    frames = [
        Frame(n, np.concatenate([cloud(noise)[len(again) :], again])[order], times)
        for n, order in ((0, slice(None)), (1, slice(None, None, -1)))
    ]
    part.new(frames[0])
    new = part.new(frames[1])
    fresh = 30_000 - len(again)
    np.testing.assert_array_equal(new.points, frames[1].points[-fresh:])
    np.testing.assert_array_equal(new.time_offset, times[-fresh:])


def test_the_array_of_before_may_be_used_again(noise: np.random.Generator) -> None:
    array, part = cloud(noise), RepeatedPart()
    part.new(Frame(0, array))
    array[:15_000] = cloud(noise)[:15_000]
    assert len(part.new(Frame(1, array)).points) == 15_000


def test_what_is_no_fault_stays(noise: np.random.Generator) -> None:
    """The robot's own body; at rest in a simulation without noise, everything except moving objects; a driver's missing
    returns."""
    first, second = cloud(noise), cloud(noise)
    body = np.concatenate([first[:6000], second[6000:]])
    assert kept(first, body) == 30_000
    at_rest = np.concatenate([first[:24_000], second[24_000:]])
    assert kept(first, at_rest) == 30_000
    assert kept(first, first) == 30_000
    for missing in (0.0, np.nan):
        holes = [points.copy() for points in (first, second)]
        for points in holes:
            points[10_000:, :3] = missing
        assert kept(*holes) == 30_000


def test_ranges_in_coarse_steps_stay(noise: np.random.Generator) -> None:
    """At rest, with the same directions, one in four ranges is measured again: this is less than the threshold."""
    directions = noise.normal(size=(30_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = noise.uniform(2, 40, 30_000)
    clouds = []
    for _ in range(2):
        steps = np.round((distance + noise.normal(0, 0.01, 30_000)) / 0.008) * 0.008
        clouds.append(np.c_[directions * steps[:, None], np.zeros(30_000)].astype(np.float32))
    assert 0.15 < (clouds[0] == clouds[1]).all(1).mean() < 0.3
    assert kept(*clouds) == 30_000


@pytest.mark.parametrize(("speed", "stuck"), [(0.0, False), (1.0, False), (2.0, True)])
def test_the_speed_says_whether_a_robot_may_have_stopped(noise: np.random.Generator, speed: float, stuck: bool) -> None:
    """The speed in m/s counts, whatever the rate of the scans. A repetition that was taken for a halt remains one."""
    points, seen = cloud(noise), RepeatedCloud()
    assert not seen.repeats(Frame(0, points), 5.0)
    seen.keep(np.eye(4), 0.0)
    assert seen.repeats(Frame(1, points), speed) is stuck
    seen.keep(np.eye(4), 0.0)
    assert seen.repeats(Frame(2, points), 0.0) is stuck
    assert not seen.repeats(Frame(3, cloud(noise)), 5.0)


@pytest.mark.parametrize(("same", "step", "stuck"), [(0.0, 0.0, True), (0.9, 0.0, False), (0.0, 0.01, False)])
def test_a_sensor_whose_clouds_differ_at_rest_never_sends_the_same_twice(
    noise: np.random.Generator, same: float, step: float, stuck: bool
) -> None:
    """3 s at rest have shown that it has noise. Two cases show no noise: a simulation without noise in which a person
    walks past, and a robot that creeps at 0.1 m/s."""
    seen = RepeatedCloud()
    for index in range(32):
        points = cloud(noise, 1000)
        assert not seen.repeats(Frame(index, points), 0.0)
        seen.keep(se3.make(np.eye(3), [index * step, 0, 0]), same)
    assert seen.repeats(Frame(32, points), 0.0) is stuck
