# SPDX-License-Identifier: Apache-2.0
"""Roads: closed roads are continuous, drives are comfortable, pose files are followed, bad files are rejected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.errors import UsageError
from dpm2_core.sim.drive import fitting_length
from dpm2_core.sim.road import make_road, read_drive
from dpm2_core.sim.settings import PRESETS, DriveConfig
from dpm2_core.sim.world import own_preset, random_stream


@pytest.mark.parametrize("kind", ["loop", "figure8"])
def test_closed_roads_close_without_a_kink(kind: str) -> None:
    road = make_road(kind, PRESETS["city"], np.random.default_rng(1), 200)
    drive = road.drive
    assert drive.closed
    before, after = drive.at(drive.length - 0.01), drive.at(0.01)
    np.testing.assert_allclose(before[0], after[0], atol=0.03)  # 2 cm of driving, 1 cm of curvature
    turn = (before[1] - after[1]) / (2 * np.pi)
    assert abs(turn - np.round(turn)) < 0.02


def test_a_figure_of_eight_crosses_itself() -> None:
    xy = make_road("figure8", PRESETS["city"], np.random.default_rng(1), 300).streets[0].xy
    apart = np.abs(np.subtract.outer(np.arange(len(xy)), np.arange(len(xy))))
    far_along = (apart > 100) & (apart < len(xy) - 100)
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
    assert distance[far_along].min() < 0.5


@pytest.mark.parametrize("kind", ["straight", "loop", "figure8", "random"])
def test_the_drive_keeps_to_its_speed_and_slows_in_curves(kind: str) -> None:
    preset = PRESETS["city"]
    road = make_road(kind, preset, np.random.default_rng(4), 300)
    times = np.arange(0, 20, 0.1)
    xy = road.drive.at(road.distance(times))[0]
    velocity = np.diff(xy, axis=0) / 0.1
    speed = np.linalg.norm(velocity, axis=1)
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / 0.1
    assert speed.max() < 1.1 * preset.speed
    assert speed.min() > 1.0
    assert np.quantile(acceleration, 0.95) < 6.0  # 4 m/s^2 sideways and 1.5 along, plus the samples' corners


@pytest.mark.parametrize("preset", ["city", "suburb", "rural"])
def test_the_lap_fits_the_number_of_frames(preset: str) -> None:
    """150 frames end at least 10 m beyond their start, but by less than a lap."""
    for seed in range(4):
        length = fitting_length(DriveConfig(preset=preset, seed=seed))
        road = make_road("loop", own_preset(preset, seed), random_stream(seed, preset, 0), length)
        overlap = float(road.distance(14.9)) - road.drive.length
        assert 10 < overlap < 25


def test_a_file_is_followed_and_its_second_lap_uses_the_first_one_s_street(poses_file: Path) -> None:
    road = make_road(str(poses_file), PRESETS["city"], np.random.default_rng(0))
    position = read_drive(poses_file)
    driven = road.drive.at(road.travelled)[0]
    off = np.linalg.norm(driven - position[:, :2], axis=1)
    assert np.median(off) < 0.15  # smoothing cuts the inside of curves a little
    assert off.max() < 0.8
    assert np.ptp(road.travelled[100:115]) < 0.2  # the stop
    lap = 2 * np.pi * 25
    main = sum(street.length for street in road.streets[: road.main])
    assert main < lap * 1.15 + 2 * 110  # the straight approach and exit; two laps would be 60 m more


def test_the_car_heads_where_the_file_says(poses_file: Path, tmp_path: Path) -> None:
    """In curves, a camera ahead of the rear axle does not look in the direction of travel; the file has its
    orientation."""
    road = make_road(str(poses_file), PRESETS["city"], np.random.default_rng(0))
    assert np.degrees(np.median(np.abs(road.slip))) < 1  # this file's car heads along its path
    rows = np.loadtxt(poses_file).reshape(-1, 3, 4)
    turned = np.radians(20.0)  # to the left: about the camera's y axis, which looks down, by the negative angle
    R = np.array([[np.cos(turned), 0, -np.sin(turned)], [0, 1, 0], [np.sin(turned), 0, np.cos(turned)]])
    rows[:, :, :3] = rows[:, :, :3] @ R
    np.savetxt(tmp_path / "turned.txt", rows.reshape(-1, 12))
    other = make_road(str(tmp_path / "turned.txt"), PRESETS["city"], np.random.default_rng(0))
    np.testing.assert_allclose(other.slip - road.slip, turned, atol=1e-9)
    time = float(road.times[40])
    assert other.slip_at(time) == other.slip[40]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0\n0 1 0 0\n", "poses.txt:1: 4 numbers, want 12"),
        ("a b c\n", "poses.txt:1: .*'a'"),
        ("", "a drive of 0 m"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0\n" * 3, "finite"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 30, "at least 20 m"),
    ],
    ids=["short lines", "words", "empty", "nan", "standing"],
)
def test_bad_files_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(UsageError, match=message):
        make_road(str(path), PRESETS["city"], np.random.default_rng(0))


def test_an_unknown_road_is_rejected_with_what_there_is() -> None:
    with pytest.raises(UsageError, match="straight, loop, figure8, random, or a file"):
        make_road("circle", PRESETS["city"], np.random.default_rng(0))
