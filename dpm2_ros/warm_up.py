# SPDX-License-Identifier: Apache-2.0
"""Work that a process does only once (loading libraries, starting their threads, tuning kernels): done before the first
cloud."""

from __future__ import annotations

import functools

import numpy as np

from dpm2_core.frame import Camera, Frame, Image, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.settings import SlamSettings
from dpm2_ros.runtime import STOP

_FRAME_COUNT = 3  # the first begins the map, the second measures the speed, the third is like all others
_PERIOD = 100_000_000  # ns
_STEP = 1.0  # m per frame
_IMAGE_SIZE = 640, 192  # pixels


@functools.cache
def warm_up(settings: SlamSettings) -> None:
    """Process a short synthetic street with these settings, in a temporary SLAM system.

    Raises:
        UsageError: a network has no weights.
    """
    slam = make_slam(settings)
    for n in range(_FRAME_COUNT):
        if STOP.is_set():
            return
        slam.odometry.request_keyframe()  # so that the network and the map process each frame
        frame = Frame(n * _PERIOD, _street(n * _STEP), images=_image() if slam.uses_images else (), index=n)
        slam.process(frame)
    slam.mapper.finish()


def _street(x: float) -> Points:
    """(N, 4) points, m, of the ground and staggered house fronts, seen from x along the street."""
    rng = np.random.default_rng(0)
    along, across = rng.uniform(-40, 40, (2, 8000))
    ground = np.column_stack([along, across / 4, np.full(8000, -1.7)])
    along, up = rng.uniform(-40, 40, 12000), rng.uniform(-1.7, 5, 12000)
    house = np.floor(along / 8).astype(int)
    front = (8 + house * 7 % 5) * np.where(rng.random(12000) < 0.5, -1, 1)
    points = np.concatenate([ground, np.column_stack([along, front, up])])
    points[:, 0] -= x
    return np.column_stack([points, rng.uniform(0, 1, len(points))]).astype(np.float32)


def _image() -> tuple[Image, ...]:
    """An image of noise, from a camera that looks along the street."""
    width, height = _IMAGE_SIZE
    K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])
    T_lidar_cam = se3.make(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), [0.3, 0.0, -0.1])
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    return (Image(pixels, Camera(K, T_lidar_cam, _IMAGE_SIZE)),)
