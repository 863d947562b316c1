# SPDX-License-Identifier: Apache-2.0
"""Corruptions affect the requested fraction of frames, the same ones for the same seed, and have the described
effect."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.data.corrupt import (
    Box,
    CorruptedSource,
    CorruptionSettings,
    exposed,
    hidden_by,
    parse_corruption,
    random_box,
)
from dpm2_core.data.source import IndexedSource
from dpm2_core.errors import UsageError
from dpm2_core.frame import Camera, Frame, Image
from dpm2_core.geometry import se3

N = 20


class Drive(IndexedSource):
    """Twenty frames of 2,000 points and one image, whose brightness shows the frame's number."""

    truth = "poses/drive.txt"

    def __init__(self) -> None:
        super().__init__("drive", N)
        rng = np.random.default_rng(0)
        self.points = rng.uniform(-30, 30, (N, 2000, 4)).astype(np.float32)
        self.camera = Camera(np.eye(3), se3.exp([0.1, 0, 0, 1.0, 0, 0]), (6, 4))

    def frame(self, position: int) -> Frame:
        image = Image(np.full((4, 6, 3), 10 + position, np.uint8), self.camera)
        offset = np.linspace(0, 0.1, 2000, dtype=np.float32)
        return Frame(position * 10**8, self.points[position], offset, (image,), position)


def corrupted(**settings: float) -> list[Frame]:
    return list(CorruptedSource(Drive(), CorruptionSettings(**settings)).frames())  # type: ignore[arg-type]


def test_nothing_asked_for_changes_nothing() -> None:
    for ours, theirs in zip(corrupted(), Drive().frames(), strict=True):
        np.testing.assert_array_equal(ours.points, theirs.points)
        np.testing.assert_array_equal(ours.images[0].pixels, theirs.images[0].pixels)
        np.testing.assert_allclose(ours.images[0].camera.T_lidar_cam, theirs.images[0].camera.T_lidar_cam, atol=1e-12)


EVERYTHING = {
    "camera": 0.3, "no_image": 0.2, "overexposed": 0.3, "underexposed": 0.3, "obstruction": 0.5, "beams": 0.2,
    "dust": 0.4, "sight": 25.0, "extrinsic_deg": 2.0, "extrinsic_m": 0.1, "time_offset": 0.2,
}  # fmt: skip


def same(a: Frame, b: Frame) -> bool:
    assert a.time_offset is not None
    assert b.time_offset is not None
    pixels = [np.array_equal(x.pixels, y.pixels) for x, y in zip(a.images, b.images, strict=False)]
    return (
        np.array_equal(a.points, b.points)
        and np.array_equal(a.time_offset, b.time_offset)
        and len(a.images) == len(b.images)
        and all(pixels)
    )


def test_same_seed_same_drive_another_seed_another() -> None:
    first, again, other = (corrupted(seed=seed, **EVERYTHING) for seed in (3, 3, 4))
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert not all(same(a, b) for a, b in zip(first, other, strict=True))


def test_a_part_of_the_drive_is_corrupted_as_the_whole() -> None:
    source = CorruptedSource(Drive(), CorruptionSettings(seed=3, **EVERYTHING))  # type: ignore[arg-type]
    for a, b in zip(list(source.frames())[7:12], source.frames(7, 12), strict=True):
        assert a.index == b.index
        assert same(a, b)


@pytest.mark.slow
@given(share=st.floats(0, 1), seed=st.integers(0, 2**32))
def test_exactly_that_share_of_frames_is_hit(share: float, seed: int) -> None:
    frames = corrupted(camera=share, no_image=0, seed=seed)
    assert sum(not f.images[0].pixels.any() for f in frames) == round(share * N)
    assert sum(not f.images for f in corrupted(no_image=share, seed=seed)) == round(share * N)


def test_a_larger_share_hits_the_same_frames_and_more() -> None:
    few, many = ({f.index for f in corrupted(no_image=x) if not f.images} for x in (0.25, 0.6))
    assert few < many


def test_one_corruption_does_not_move_another() -> None:
    alone = {f.index for f in corrupted(no_image=0.3) if not f.images}
    assert {f.index for f in corrupted(no_image=0.3, obstruction=0.5, camera=0.5) if not f.images} == alone


def segment_meets(box: Box, point: np.ndarray) -> bool:
    """Brute force: whether any of 4,000 positions on the segment is in the box."""
    places = np.linspace(0, 1, 4000)[:, None] * point
    inside = np.abs(se3.transform(se3.inverse(box.T_lidar_box), places)) <= box.half
    return bool(inside.all(1).any())


@pytest.mark.slow
@given(seed=st.integers(0, 2**32))
def test_hidden_points_are_those_whose_ray_meets_the_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = random_box(rng)
    points = rng.normal(size=(40, 3)) * 10 + box.T_lidar_box[:3, 3] * rng.uniform(0, 3, (40, 1))
    hidden = hidden_by(box, points)
    bigger, smaller = (box._replace(half=box.half * scale) for scale in (1.01, 0.99))  # sampling misses thin corners
    for point, result in zip(points, hidden, strict=True):
        assert result or not segment_meets(smaller, point)
        assert not result or segment_meets(bigger, point)


@given(seed=st.integers(0, 2**32))
def test_the_box_never_swallows_the_sensor(seed: int) -> None:
    box = random_box(np.random.default_rng(seed))
    assert np.linalg.norm(box.T_lidar_box[:3, 3]) >= np.linalg.norm(box.half) + 0.5
    assert 0.25 <= box.half.min() <= box.half.max() <= 1.5


def test_rays_along_the_axes_of_a_box_and_points_that_are_none() -> None:
    box = Box(se3.make(np.eye(3), [5, 0, 0]), np.array([1.0, 1.0, 1.0]))
    points = np.array(
        [[10, 0, 0], [3.9, 0, 0], [4.1, 0, 0], [-10, 0, 0], [0, 10, 0], [10, 2.6, 0], [0, 0, 0], [np.nan, 0, 0]]
    )
    expected = [True, False, True, False, False, False, False, False]
    np.testing.assert_array_equal(hidden_by(box, points.astype(np.float32)), expected)


def test_dust_returns_its_share_of_pulses_from_near_by() -> None:
    """The points stay on their rays. The points that are moved at 0.3 are moved in the same way at 0.6."""
    clean = [frame.points for frame in Drive().frames()]
    some, many = ([frame.points for frame in corrupted(dust=fraction)] for fraction in (0.3, 0.6))
    for points, fewer, more in zip(clean, some, many, strict=True):
        away, nearer = (np.linalg.norm(p[:, :3].astype(float), axis=1) for p in (points, more))
        moved = nearer < away - 1e-3
        np.testing.assert_allclose(moved.mean(), 0.6, atol=0.05)  # hardly any point of 60 m is within 6 m
        assert nearer[moved].min() > 0.39
        assert nearer[moved].max() < 6.01
        np.testing.assert_allclose(
            more[moved, :3] / nearer[moved, None], points[moved, :3] / away[moved, None], atol=1e-5
        )
        changed = (fewer != points).any(1)
        np.testing.assert_array_equal(fewer[changed], more[changed])


def test_beyond_sight_nothing_returns() -> None:
    for frame, clean in zip(corrupted(sight=25.0), Drive().frames(), strict=True):
        away = np.linalg.norm(clean.points[:, :3], axis=1)
        np.testing.assert_array_equal(frame.points, clean.points[away <= 25])
        assert len(frame.time_offset) == len(frame.points)


def test_an_obstruction_takes_points_of_its_share_of_frames_and_their_times() -> None:
    frames = corrupted(obstruction=0.5, seed=1)
    assert sum(len(f.points) < 2000 for f in frames) == N // 2  # a box hides some of 2,000 points all around
    assert all(f.time_offset is not None and len(f.time_offset) == len(f.points) for f in frames)


def test_dead_beams_are_dead_in_every_frame() -> None:
    def bands(frames: list[Frame]) -> set[int]:
        xyz = np.concatenate([f.points[:, :3] for f in frames])
        return set(np.floor((np.arctan2(xyz[:, 2], np.hypot(*xyz[:, :2].T)) + np.pi / 2) / np.radians(0.4)).astype(int))

    whole, left = bands(list(Drive().frames())), bands(corrupted(beams=0.3))
    assert 0.2 < 1 - len(left) / len(whole) < 0.4  # 450 bands, of which the points fill most
    assert not corrupted(beams=1.0)[0].points.size


def test_exposure_is_monotonous_clips_and_is_undone_by_its_opposite() -> None:
    ramp = np.arange(256, dtype=np.uint8)
    assert (np.diff(exposed(ramp, 2).astype(int)) >= 0).all()
    assert exposed(ramp, 2)[200] == 255
    np.testing.assert_array_equal(exposed(ramp, 0), ramp)
    dark = ramp[:60]
    np.testing.assert_allclose(exposed(exposed(dark, 2), -2).astype(int), dark, atol=1)  # rounding


def test_the_calibration_is_off_by_what_was_asked_for() -> None:
    off = (
        se3.inverse(Drive().camera.T_lidar_cam)
        @ corrupted(extrinsic_deg=2, extrinsic_m=0.3)[5].images[0].camera.T_lidar_cam
    )
    assert np.degrees(se3.angle(off)) == pytest.approx(2)
    assert np.linalg.norm(off[:3, 3]) == pytest.approx(0.3)


@pytest.mark.parametrize(("late", "by"), [(0.1, 1), (0.25, 3), (0.0, 0)])
def test_late_images_are_of_an_earlier_frame(late: float, by: int) -> None:
    numbers = [f.images[0].pixels[0, 0, 0] - 10 if f.images else None for f in corrupted(time_offset=late)]
    assert numbers == [None] * by + list(range(N - by))


def test_settings_from_the_command_line() -> None:
    result = parse_corruption("camera=0.3, obstruction=0.5,seed=1")
    assert (result.camera, result.obstruction, result.seed) == (0.3, 0.5, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera", "want NAME=VALUE"),
        ("", "want NAME=VALUE"),
        ("camera=2", "--corrupt camera=2: camera: input should be less than or equal to 1"),
        ("camera=half", "--corrupt camera=half: camera: "),
        ("kamera=0.3", "unknown key kamera; allowed here: seed, camera"),
    ],
)
def test_mistakes_are_named(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse_corruption(text)
