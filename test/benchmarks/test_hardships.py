# SPDX-License-Identifier: Apache-2.0
"""Hardships made from a drive: the input of the methods, and the verdict on their result."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hardships import Case, cases, judged
from dpm2_core.estimates import State
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3


def drive(count: int = 120, turning: float = 0.02) -> tuple[list[Frame], Array]:
    """1 m and `turning` rad between frames, 0.1 s apart; frame i has i points."""
    step = se3.exp([0, 0, turning, 1.0, 0, 0])
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return [Frame(i * 10**8, np.ones((i, 4), np.float32), index=i) for i in range(count)], np.stack(poses)


@pytest.fixture(scope="module")
def hard() -> dict[str, Case]:
    return {case.name: case for case in cases(*drive())}


def test_a_long_drive_has_room_for_all(hard: dict[str, Case]) -> None:
    assert list(hard) == [
        "every 1", "every 3", "every 6", "every 10",
        "gap 1 s", "gap 2 s", "gap 3 s", "gap 5 s", "blind 1 s", "blind 2 s", "blind 3 s",
        "start at speed", "start in a curve", "fog 40 m", "fog 20 m", "kidnapped",
    ]  # fmt: skip
    assert all(len(case.frames) == len(case.truth) for case in hard.values())
    assert [case.name for case in cases(*drive(6))] == ["every 1", "every 3"]
    assert "start in a curve" not in {case.name for case in cases(*drive(60, turning=0.0))}


def test_stamps_advance_in_every_case(hard: dict[str, Case]) -> None:
    for case in hard.values():
        assert (np.diff([frame.stamp for frame in case.frames]) > 0).all()


def test_frames_are_those_of_their_poses(hard: dict[str, Case]) -> None:
    truth = drive()[1]
    for case in hard.values():
        np.testing.assert_array_equal(case.truth, truth[[frame.index for frame in case.frames]])


def test_a_gap_is_empty_and_a_blind_sensor_sees_its_window(hard: dict[str, Case]) -> None:
    gap, blind = hard["gap 2 s"], hard["blind 2 s"]
    before, after = gap.frames[gap.event - 1], gap.frames[gap.event]
    assert after.index - before.index == 21
    dirty = [frame for frame in blind.frames if np.abs(frame.points[:, :3]).max() <= 0.5]
    assert len(dirty) == 20
    assert dirty[-1] is blind.frames[blind.event - 1]
    assert dirty[0] is blind.frames[blind.base + 1]  # frames coasted without visible points are no base for the verdict
    assert gap.base == gap.event - 1


def test_in_fog_one_sees_the_fog() -> None:
    """Of points 30 m away, fog with 20 m sight returns 6 in 10 from the fog itself; the rest is lost."""
    frames = [Frame(i * 10**8, np.full((200, 4), 30 / np.sqrt(3), np.float32), index=i) for i in range(60)]
    case = next(case for case in cases(frames, np.tile(np.eye(4), (60, 1, 1))) if case.name == "fog 20 m")
    away = np.concatenate([np.linalg.norm(frame.points[:, :3], axis=1) for frame in case.frames])
    np.testing.assert_allclose(len(away) / 12_000, 0.6, atol=0.02)
    assert away.max() < 6.01


def test_who_is_kidnapped_is_back_where_it_was(hard: dict[str, Case]) -> None:
    case = hard["kidnapped"]
    seen = [frame.index for frame in case.frames[: case.event]]
    assert {frame.index for frame in case.frames[case.event :]} <= set(seen)
    assert np.linalg.norm(case.truth[case.event][:3, 3] - case.truth[case.event - 1][:3, 3]) > 10


@pytest.mark.parametrize(
    ("states", "verdict"),
    [
        ([None] * 40, "silent"),
        ([State.TRACKING] * 40, "silent"),
        ([State.DEGRADED] * 40, "said"),
        ([State.DEGRADED] * 39 + [State.TRACKING], "silent"),
    ],
)
def test_standing_still_is_wrong(states: list[State | None], verdict: str) -> None:
    frames, truth = drive(40)
    case = Case("a", frames, truth)
    assert judged(case, truth, states) == {"error_m": 0.0, "verdict": "right"}
    still = judged(case, np.repeat(np.eye(4)[None], 40, 0), states)
    assert still["verdict"] == verdict
    assert still["error_m"] > 30


def test_what_was_wrong_before_the_event_does_not_count() -> None:
    """The whole trajectory, moved and rotated, counts as the same one."""
    frames, truth = drive(40)
    moved = se3.exp([0, 0, 1.0, 5.0, 3.0, 0]) @ truth
    moved[:9] = np.eye(4)
    assert judged(Case("a", frames, truth, 10, 9), moved, [None] * 40)["verdict"] == "right"
