# SPDX-License-Identifier: Apache-2.0
"""An object with inconsistent fields cannot be made, and the message names the inconsistency."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dpm2_core.frame import Camera, Fix, Frame, Guess, Image
from dpm2_core.geometry import se3

CAMERA = Camera(K=np.eye(3), T_lidar_cam=np.eye(4), size=(40, 30), name="left")


def _pixels(height: int, width: int, channels: int = 3) -> np.ndarray:
    return np.zeros((height, width, channels), np.uint8)


def test_an_image_fits_its_camera() -> None:
    assert Image(_pixels(30, 40), CAMERA).camera is CAMERA


@pytest.mark.parametrize("pixels", [_pixels(40, 30), _pixels(30, 40, 1), _pixels(30, 40)[..., 0]])
def test_an_image_of_another_shape_is_rejected(pixels: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"left: image of .* calibration for \(30, 40\)"):
        Image(pixels, CAMERA)


def test_a_camera_wants_matrices_of_the_right_shape() -> None:
    with pytest.raises(ValueError, match=r"camera: K is \(3, 4\)"):
        Camera(K=np.zeros((3, 4)), T_lidar_cam=np.eye(4), size=(40, 30))
    with pytest.raises(ValueError, match=r"T_lidar_cam \(3, 4\)"):
        Camera(K=np.eye(3), T_lidar_cam=np.zeros((3, 4)), size=(40, 30))


def test_a_point_is_seen_where_it_was_in_an_image_of_another_size() -> None:
    """Pixel centers are at integers: the middle of the image is (size - 1) / 2, not size / 2, in both sizes."""
    camera = Camera(np.array([[300.0, 0, 330], [0, 310, 110], [0, 0, 1]]), np.eye(4), (640, 240))
    at = camera.K @ [0.4, -0.2, 1.0]
    v, u = np.mgrid[:240, :640]
    spot = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * 8.0**2)).astype(np.float32)
    for size in ((320, 120), (160, 80), (640, 240)):
        small = cv2.resize(spot, size, interpolation=cv2.INTER_AREA)
        v, u = np.mgrid[: size[1], : size[0]]
        middle = np.array([(u * small).sum(), (v * small).sum()]) / small.sum()
        expected = (camera.resized(*size).K @ [0.4, -0.2, 1.0])[:2]
        assert np.abs(middle - expected).max() < 0.01, "pixels; half a pixel of the larger image is 0.25 and more"


def test_what_would_be_read_as_something_else_is_refused() -> None:
    """Such values are errors. Previously, transposed matrices made a camera unusable and a drive wrong by its length,
    and seconds were read as nanoseconds."""
    moved = se3.make(np.eye(3), np.array([1.0, 2.0, 3.0]))
    with pytest.raises(ValueError, match=r"left: T_lidar_cam is no rigid transform"):
        replace(CAMERA, T_lidar_cam=moved.T)
    for K in (np.array([[9.0, 0, 0], [0, 9, 0], [20, 15, 1]]), np.diag([0.0, 9, 1]), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match=r"left: K is no matrix of intrinsics"):
            replace(CAMERA, K=K)
    for kind in (np.float32, np.uint16):
        with pytest.raises(ValueError, match=r"left: pixels are .*, want uint8"):
            Image(np.zeros((30, 40, 3), kind), CAMERA)  # type: ignore[arg-type]
    for T in (moved.T, np.zeros((4, 4)), 2 * np.eye(4)):
        with pytest.raises(ValueError, match=r"guess: its pose is no rigid transform"):
            Guess(T)
    points = np.zeros((3, 4), np.float32)
    with pytest.raises(ValueError, match=r"frame 0: its stamp is 1.5, want ns"):
        Frame(1.5, points)  # type: ignore[arg-type]
    assert Frame(np.int64(3), points).stamp == 3  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"frame 1.5: its index is no integer"):
        Frame(0, points, index=1.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="frame 0: some time offsets are not finite"):
        Frame(0, points, np.array([0, np.nan, 0], np.float32))


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.uint64])
def test_stamps_and_indices_of_numpy_become_plain_integers(kind: type) -> None:
    """SQLite stores NumPy's integers as bytes, and unsigned ones have no negative differences."""
    frame = Frame(kind(3), np.zeros((0, 4), np.float32), index=kind(2))
    fix = Fix(kind(3), np.array([49.0, 8.4, 110.0]), np.eye(3), np.zeros(3))
    assert [type(number) for number in (frame.stamp, frame.index, fix.stamp)] == [int, int, int]
    assert (frame.stamp, frame.index, fix.stamp) == (3, 2, 3)


def test_a_frame_may_be_empty_and_may_hold_nan() -> None:
    for points in (np.zeros((0, 4), np.float32), np.full((3, 4), np.nan, np.float32)):
        assert Frame(stamp=0, points=points).problem is None


@pytest.mark.parametrize("shape", [(5,), (5, 3), (1, 5, 4)])
def test_points_without_intensity_or_of_another_rank_are_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"frame 7: points are .* want \(N, 4\)"):
        Frame(stamp=0, points=np.zeros(shape, np.float32), index=7)


def test_every_point_wants_its_time_offset() -> None:
    points = np.zeros((5, 4), np.float32)
    assert Frame(stamp=0, points=points, time_offset=np.zeros(5, np.float32)).time_offset is not None
    with pytest.raises(ValueError, match="4 time offsets for 5 points"):
        Frame(stamp=0, points=points, time_offset=np.zeros(4, np.float32))
    with pytest.raises(ValueError, match="frame 7: its time offsets span 100, want seconds"):  # in ms; once accepted
        Frame(stamp=0, points=points, time_offset=np.linspace(0, 100, 5, dtype=np.float32), index=7)


def test_nouns_cannot_be_changed() -> None:
    frame = Frame(stamp=0, points=np.zeros((1, 4), np.float32))
    with pytest.raises(AttributeError):
        frame.stamp = 1  # type: ignore[misc]
