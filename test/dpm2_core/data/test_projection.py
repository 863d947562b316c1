# SPDX-License-Identifier: Apache-2.0
"""Painted points are where the camera sees them, and a wrong extrinsic moves them."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.data.projection import painted
from dpm2_core.frame import R_AHEAD, Camera, Image, Points
from dpm2_core.geometry import se3

K = np.array([[100.0, 0, 80], [0, 100.0, 60], [0, 0, 1]])
# the camera looks along the LiDAR's x
T_LIDAR_CAM = se3.make(R_AHEAD, np.zeros(3))
BLACK = np.zeros((120, 160, 3), np.uint8)


def shown(*points: tuple[float, float, float], **changes: object) -> list[tuple[int, int]]:
    """Pixels (u, v) that are painted."""
    camera = Camera(**({"K": K, "T_lidar_cam": T_LIDAR_CAM, "size": (160, 120)} | changes))  # type: ignore[arg-type]
    cloud: Points = np.array([(*p, 0.5) for p in points], np.float32).reshape(-1, 4)
    v, u = np.nonzero(painted(Image(BLACK, camera), cloud).any(2))
    return sorted(zip(u.tolist(), v.tolist(), strict=True))


def test_a_point_is_where_the_camera_sees_it() -> None:
    """10 m ahead, 1 m to the left and 2 m up: 10 pixels to the left, 20 up."""
    assert shown((10.0, 1.0, 2.0)) == [(70, 40)]


def test_what_the_camera_does_not_see_is_not_painted() -> None:
    assert shown((-10.0, 0.0, 0.0), (10.0, 30.0, 0.0), (np.nan, 0.0, 0.0), (500.0, 0.0, 0.0), (0.1, 0.0, 0.0)) == []
    assert shown() == []


def test_near_points_are_over_far_ones_and_redder() -> None:
    camera = Camera(K, T_LIDAR_CAM, (160, 120))
    both = np.array([[3.0, 0, 0, 0], [50.0, 0, 0, 0]], np.float32)
    near, far = (painted(Image(BLACK, camera), cloud)[60, 80] for cloud in (both, both[1:]))
    np.testing.assert_array_equal(near, painted(Image(BLACK, camera), both[::-1])[60, 80])
    assert int(near[0]) - int(near[2]) > int(far[0]) - int(far[2])
    assert (BLACK == 0).all()  # the image itself is not changed


def test_the_lens_bends_and_a_wrong_extrinsic_shows() -> None:
    straight = shown((10.0, -5.0, 0.0))
    assert straight == [(130, 60)]
    assert shown((10.0, -5.0, 0.0), distortion=(-0.2, 0.0, 0.0, 0.0)) == [(128, 60)]  # 50 * (1 - 0.2 * 0.25)
    turned = T_LIDAR_CAM @ se3.exp([0.0, np.radians(2.0), 0.0, 0.0, 0.0, 0.0])
    (u, _v), *_ = shown((10.0, -5.0, 0.0), T_lidar_cam=turned)
    assert abs(u - 130) >= 3


@pytest.mark.parametrize("distortion", [(5.0, 5.0, 0.0, 0.0, 5.0), (-1.0, 0.0, 0.0, 0.0)])
def test_no_distortion_is_too_strange(distortion: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    shown(*[tuple(p) for p in rng.uniform(-20, 20, (500, 3))], distortion=distortion)
