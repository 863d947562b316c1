# SPDX-License-Identifier: Apache-2.0
"""Image corners on the surfaces of a scan: they are detected again, have the right position, and look alike from
elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.corners import TEXTURE, Corners, image_corners

from ...helpers.painted import SIZE, T_LIDAR_CAM, WALL, K, paint, picture, scan


def seen(wall: np.ndarray, x: float, most: int = 96) -> Corners:
    return image_corners(picture(wall, x), K, T_LIDAR_CAM, scan(x, round(10 * x)), most)


def moved(T: Array, points: Points) -> Points:
    return se3.transform(T, points).astype(np.float32)


def test_corners_of_a_wall_lie_on_it() -> None:
    """On a plane the depth of a pixel is known to the noise of the scan: 1 cm, less if eight points are fitted."""
    found = seen(paint(0), 2.0)
    assert len(found.xyz) > 50
    assert np.abs(found.xyz[:, 1] - WALL).max() < 0.05


def test_they_meet_again_and_look_alike() -> None:
    """From 1.5 m farther along a flat wall. By chance, 7 % would coincide, and 1 % would be the most similar."""
    wall = paint(1)
    here, there = seen(wall, 2.0), seen(wall, 3.5)
    apart = np.linalg.norm((here.xyz - np.array([1.5, 0, 0], np.float32))[:, None] - there.xyz[None], axis=-1)
    met = apart.min(1) < 0.2
    assert met.mean() > 0.3
    alike = (here.texture @ there.texture.T).argmax(1)
    assert (apart[np.arange(len(alike)), alike] < 0.4)[met].mean() > 0.7


@settings(max_examples=20, deadline=None)
@given(st.floats(-3, 3), st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_the_axes_of_the_lidar_do_not_matter(yaw: float, t: list[float]) -> None:
    """Corners follow a change of the LiDAR's axes; 1e-3 m is the accuracy of float32 in the depth of the points."""
    wall = paint(2)
    pixels, cloud = picture(wall, 2.0), scan(2.0, 0)
    T = se3.exp([0.02, -0.03, yaw, 0, 0, 0])
    T[:3, 3] = t
    plain = image_corners(pixels, K, T_LIDAR_CAM, cloud, 500)
    turned = image_corners(pixels, K, T @ T_LIDAR_CAM, moved(T, cloud), 500)
    # A corner exactly at the limit of a rule may fall to the other side of it.
    apart = np.linalg.norm(moved(T, plain.xyz)[:, None] - turned.xyz[None], axis=-1).min(1)
    assert abs(len(plain.xyz) - len(turned.xyz)) <= 2
    assert np.quantile(apart, 0.9) < 1e-3


def test_brightness_and_contrast_do_not_matter() -> None:
    """With half the exposure, a camera shows the same corners, except where rounding changes the gray level."""
    wall, cloud = paint(3), scan(2.0, 0)
    pixels = picture(wall, 2.0)
    plain = image_corners(pixels, K, T_LIDAR_CAM, cloud, 96)
    dark = image_corners((pixels // 2), K, T_LIDAR_CAM, cloud, 96)
    apart = np.linalg.norm(plain.xyz[:, None] - dark.xyz[None], axis=-1)
    same = apart.min(1) < 0.05
    assert same.mean() > 0.7
    assert np.median((plain.texture * dark.texture[apart.argmin(1)]).sum(1)[same]) > 0.95


def test_patches_are_of_unit_length_without_their_mean() -> None:
    texture = seen(paint(4), 2.0).texture
    assert texture.shape[1] == TEXTURE
    assert np.allclose(np.linalg.norm(texture, axis=1), 1, atol=1e-5)
    assert np.allclose(texture.mean(1), 0, atol=1e-6)


def test_as_many_as_asked_and_apart() -> None:
    found = seen(paint(5), 2.0, 20)
    apart = np.linalg.norm(found.xyz[:, None] - found.xyz[None], axis=-1)
    assert len(found.xyz) == 20
    assert apart[~np.eye(20, dtype=bool)].min() > 0.5


def test_no_corner_on_the_border_of_two_surfaces() -> None:
    """A board 3 m in front of the wall: a corner whose neighborhood is half board, half wall has no depth."""
    noise = np.random.default_rng(0)
    board = np.stack([noise.uniform(10, 11, 2000), np.full(2000, 3.0), noise.uniform(-1, 2, 2000)], 1)
    cloud = np.concatenate([scan(0.0, 0), board.astype(np.float32)])
    found = image_corners(picture(paint(6), 0.0), K, T_LIDAR_CAM, cloud, 200).xyz
    on_wall, on_board = np.abs(found[:, 1] - WALL) < 0.3, np.abs(found[:, 1] - 3.0) < 0.3
    assert len(found) > 20
    assert (on_wall | on_board).all()


def test_rain_before_a_wall_does_not_hide_it() -> None:
    """A fifth of the returns come from drops: two or three of 12 points around a corner. A plane through all of them
    would be meters off."""
    noise = np.random.default_rng(0)
    cloud = scan(2.0, 0)
    wet = noise.random(len(cloud)) < 0.2
    cloud[wet] *= noise.uniform(0.2, 0.9, (wet.sum(), 1)).astype(np.float32)
    found = image_corners(picture(paint(0), 2.0), K, T_LIDAR_CAM, cloud, 96).xyz
    assert len(found) > 50
    assert np.quantile(np.abs(found[:, 1] - WALL), 0.9) < 0.1


@pytest.mark.parametrize(
    ("pixels", "cloud"),
    [
        (np.zeros((*SIZE, 3), np.uint8), scan(0.0, 0)),
        (np.full((*SIZE, 3), 255, np.uint8), scan(0.0, 0)),
        (picture(paint(0), 2.0), np.zeros((0, 3), np.float32)),
        (picture(paint(0), 2.0), scan(2.0, 0)[:7]),
        (picture(paint(0), 2.0), scan(2.0, 0) * np.float32([1, -1, 1])),
    ],
    ids=["black", "white", "no points", "too few points", "points on the other side"],
)
def test_none_where_image_or_scan_shows_nothing(pixels: np.ndarray, cloud: Points) -> None:
    found = image_corners(pixels, K, T_LIDAR_CAM, cloud, 96)
    assert found.xyz.shape == (0, 3)
    assert found.texture.shape == (0, TEXTURE)
