# SPDX-License-Identifier: Apache-2.0
"""Images as the network reads them: at its size and undistorted; unchanged if they already are."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from dpm2_core.frame import Camera, Image
from dpm2_core.network.images import small_image
from dpm2_core.network.settings import ImageSettings
from dpm2_core.network.views import collate_views

from ...helpers.scenes import make_image

SETTINGS = ImageSettings(size=(60, 80))
BARREL = (-0.3, 0.08, 0.001, -0.002)


def test_a_distorted_image_shows_a_point_where_the_camera_says() -> None:
    """A dot near the border, 9 pixels from its pinhole projection, is within half a pixel of it afterwards."""
    K = np.array([[150.0, 0, 159.5], [0, 150.0, 119.5], [0, 0, 1]])
    point = np.array([0.8, 0.5, 1.0])
    at = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), K, np.array(BARREL))[0].ravel()
    pixels = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(pixels, tuple(int(x) for x in np.round(at)), 5, (255, 255, 255), -1)
    assert np.linalg.norm(at - (K @ point)[:2]) > 9
    small = small_image(Image(pixels, Camera(K, np.eye(4), (320, 240), BARREL)), SETTINGS)
    assert small.camera.size == (80, 60)
    assert small.camera.distortion == ()
    bright = small.pixels[..., 0].astype(float)
    v, u = np.indices(bright.shape)
    middle = np.array([(u * bright).sum(), (v * bright).sum()]) / bright.sum()
    assert np.abs(middle - (small.camera.K @ point)[:2]).max() < 0.5


def test_the_intrinsics_move_with_the_pixels() -> None:
    """A bright pixel's ray is the same before and after halving: centers of pixels are at integers."""
    pixels = np.zeros((64, 128, 3), np.uint8)
    pixels[20:22, 40:42] = 255  # center (40.5, 20.5)
    K = np.array([[60.0, 0, 63.5], [0, 60.0, 31.5], [0, 0, 1]])
    small = small_image(Image(pixels, Camera(K, np.eye(4), (128, 64))), ImageSettings(size=(32, 64)))
    bright = small.pixels[..., 0]
    v, u = np.unravel_index(bright.argmax(), bright.shape)
    before = np.linalg.solve(K, [40.5, 20.5, 1])
    np.testing.assert_allclose(np.linalg.solve(small.camera.K, [u, v, 1]), before, atol=1e-9)


def test_a_small_image_is_read_as_the_image_itself(noise: np.random.Generator) -> None:
    image = make_image(noise, (320, 240))
    image = replace(image, camera=replace(image.camera, distortion=BARREL))
    small = small_image(image, SETTINGS)
    assert small_image(small, SETTINGS) is small
    of_both = [collate_views([[i]], SETTINGS) for i in (image, small)]
    assert of_both[0] is not None
    assert of_both[1] is not None
    for one, other in zip(*of_both, strict=True):
        assert one.equal(other)


def test_frames_without_an_image_are_masked(noise: np.random.Generator) -> None:
    views = collate_views([[make_image(noise)], [], [make_image(noise), make_image(noise)]], SETTINGS)
    assert views is not None
    assert views.present.tolist() == [[True, False], [False, False], [True, True]]
    assert collate_views([[], []], SETTINGS) is None
