# SPDX-License-Identifier: Apache-2.0
"""What a run records about its frames."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.trajectory import Trajectory
from dpm2_core.estimates import BETWEEN, OdometryResult, Registration, State
from dpm2_core.evaluation.run_result import Result
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.settings import Config, SlamSettings


def test_frames_with_a_bad_image_or_bad_times_are_counted(recording: Path) -> None:
    """They are in timing.json, which has no such entry if there was no problem."""
    source = open_source(recording, InputSettings(images=False))
    result = Result(source, Config(), make_mapper(SlamSettings()), None, "")
    found = Registration(np.eye(4), np.eye(6))
    good = OdometryResult(0, 0, np.eye(4), np.eye(6), np.zeros(6), State.TRACKING, found)
    result.add(good)
    assert "problems" not in result.timing
    result.add(replace(good, repeated=frozenset({"left"})))
    result.add(replace(good, repeated=frozenset({"left"}), times="wrong times"))
    again = "the same image as before: the camera or its driver repeats itself"
    assert result.timing["problems"] == {again: 2, "wrong times": 1}


def test_a_run_of_parts_of_sweeps_is_saved_with_the_times_of_the_sweeps(recording: Path, tmp_path: Path) -> None:
    """A part that completes no sweep is not registered: only the map's stage has a time. Saving raised ValueError."""
    source = open_source(recording, InputSettings(images=False))
    result = Result(source, Config(), make_mapper(SlamSettings()), None, "")
    found = Registration(np.eye(4), np.eye(6), method="geometric")
    whole = OdometryResult(0, 0, np.eye(4), np.eye(6), np.zeros(6), State.TRACKING, found)
    only_part = replace(found, method=BETWEEN, ok=False)
    for i in range(10):
        seconds = {"register": 0.02, "map": 0.01} if i in (0, 9) else {"map": 0.0}
        result.add(replace(whole, stamp=i, registration=found if i in (0, 9) else only_part, seconds=seconds))
    assert result.fps == pytest.approx(10 / 0.06)
    result.save(tmp_path)
    rows = list(csv.DictReader((tmp_path / "frames.csv").open()))
    assert [row["register_ms"] for row in rows] == ["20.000", *["0.000"] * 8, "20.000"]
    assert result.timing["stages_ms"]["total"] == {"median": 30.0, "p95": 30.0}


@pytest.mark.parametrize("numbered", [False, True])
def test_speeds_are_those_of_the_drive_where_frames_are_missing(recording: Path, numbered: bool) -> None:
    """At 20 m/s and 20 scans per second, four missing seconds do not change the speed; previously, it was 70 m/s."""
    frames = np.r_[0:60, 140:300]
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, 0, 3] = frames
    source = open_source(recording, InputSettings(images=False))
    source.T_cam_lidar = None  # type: ignore[misc]
    truth = Trajectory(poses, frames, "kitti-indexed") if numbered else poses
    result = Result(source, Config(), make_mapper(SlamSettings()), truth, "")
    registration = Registration(np.eye(4), np.eye(6))
    for frame, pose in zip(frames.tolist(), poses, strict=True):
        result.add(
            OdometryResult(50_000_000 * frame, frame, pose, np.eye(6), np.zeros(6), State.TRACKING, registration)
        )
    assert result.metrics is not None
    assert {row.speed_mps for row in result.metrics.per_speed} == {20.0}
