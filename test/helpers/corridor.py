# SPDX-License-Identifier: Apache-2.0
"""An endless corridor: the points do not constrain the position along it, but the paint on its walls does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from dpm2_core.frame import R_AHEAD, Array, Camera, Frame, Image
from dpm2_core.geometry import se3

HALF, HEIGHT = 4.0, 1.8  # m: from the sensor to the walls, and to floor and ceiling
AHEAD = 14.0  # m, to the truck
T_LIDAR_CAM = se3.make(R_AHEAD, np.zeros(3))
CAMERA = Camera(np.array([[300, 0, 319.5], [0, 300, 119.5], [0, 0, 1.0]]), T_LIDAR_CAM, (640, 240))
Paint = Callable[[Array], Array]


def random_paint(seed: int = 0) -> Paint:
    """Brightness (N,) of points (N, 3): smooth noise of 10 cm along the corridor and around it."""
    noise = np.random.default_rng(seed).uniform(0, 255, (64, 2048)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)

    def paint(points: Array) -> Array:
        around = 10 * np.where(np.abs(points[:, 1]) > HALF - 1e-6, points[:, 2] + 2, points[:, 1] + 2.5)
        u, v = (10 * points[:, 0] + 200) % 2040, around % 60
        return map_coordinates(noise, [v, u], order=1)

    return paint


def stripes(points: Array) -> Array:
    """Paint that repeats every 2 m."""
    return 128 + 100 * np.sign(np.sin(np.pi * points[:, 0]))


def with_truck(paint: Paint, x: float) -> Paint:
    """The paint, and the white back of a truck `AHEAD` m ahead of `x`."""
    return lambda points: np.where(np.abs(points[:, 0] - x - AHEAD) < 1e-6, 250.0, paint(points))


def hits(rays: Array, x: float, truck: bool) -> Array:
    """Intersections (N, 3) of rays (N, 3) from (x, 0, 0) with walls, floor or ceiling, or the truck, in the
    corridor."""
    with np.errstate(divide="ignore"):
        way = np.minimum(HALF / np.abs(rays[:, 1]), HEIGHT / np.abs(rays[:, 2]))
        back = AHEAD / rays[:, 0]
    on_truck = truck & (rays[:, 0] > 0) & (back < way) & (np.abs(back * rays[:, 1]) < HALF / 2)
    return np.clip(np.where(on_truck, back, way), 0, 80)[:, None] * rays + [x, 0, 0]


def seen(x: float, paint: Paint, camera: Camera, gain: float = 1.0, truck: bool = False) -> Image:
    """Image of a camera at `x` m along the corridor; `gain` is the exposure."""
    u, v = np.meshgrid(np.arange(640), np.arange(240))
    rays = np.c_[u.ravel(), v.ravel(), np.ones(u.size)] @ np.linalg.inv(camera.K).T @ camera.T_lidar_cam[:3, :3].T
    painted = with_truck(paint, x) if truck else paint
    gray = np.clip(gain * painted(hits(rays, x, truck)).reshape(u.shape), 0, 255).astype(np.uint8)
    return Image(np.repeat(gray[..., None], 3, 2), camera)


def with_intensities(one: Frame, x: float, paint: Paint) -> Frame:
    """The same scan from `x` m, with the brightness of the paint as intensities."""
    there = one.points[:, :3].astype(np.float64)
    there[:, 1:] = np.clip(there[:, 1:], [-HALF, -HEIGHT], [HALF, HEIGHT])  # removes the range noise
    there[:, 0] += x
    brightness = paint(there) / 255
    return replace(one, points=np.c_[one.points[:, :3], brightness].astype(np.float32))


def frame(x: float, paint: Paint, index: int = 0, gain: float = 1.0, truck: bool = False) -> Frame:
    """Scan and image from `x` m along the corridor, optionally with a truck that drives ahead; `gain` is the
    exposure."""
    noise = np.random.default_rng(index)
    azimuth, elevation = noise.uniform(-np.pi, np.pi, 20_000), noise.uniform(-0.4, 0.4, 20_000)
    rays = np.c_[np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    points = hits(rays, x, truck) - [x, 0, 0] + noise.normal(0, 0.01, rays.shape)
    points = np.c_[points, np.ones(len(points))].astype(np.float32)
    return Frame(index * 10**8, points, images=(seen(x, paint, CAMERA, gain, truck),), index=index)
