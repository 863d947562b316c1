# SPDX-License-Identifier: Apache-2.0
"""A rectified color camera simulated by ray casting: shadows, exposure, vignetting, noise."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import R_AHEAD, Array, Camera
from dpm2_core.geometry import se3
from dpm2_core.sim.lens import through_lens
from dpm2_core.sim.light import Light
from dpm2_core.sim.materials import Material
from dpm2_core.sim.mesh import Float, Hits, Mesh, rotated
from dpm2_core.sim.settings import CameraConfig
from dpm2_core.sim.shading import VisiblePoints
from dpm2_core.sim.traffic import DynamicObjects
from dpm2_core.sim.world import World

_TO_LINEAR = (np.arange(256, dtype=np.float32) / 255) ** np.float32(2.2)
_RESPONSE = 255 * np.minimum(np.arange(4096, dtype=np.float32) / 4096 * 1.25, 1) ** np.float32(1 / 2.2)
_HAZE_COLOR = np.array([0.72, 0.78, 0.86], np.float32)
_BAND_ROWS = 32
"""Number of pixel rows that are processed at a time."""
REACH = 600.0
"""Visible range, m."""


def calibration(config: CameraConfig) -> Camera:
    """The camera on the car: facing ahead, 0.27 m ahead of and 0.08 m below the LiDAR, 0.06 m left of its middle."""
    K = np.array([[config.focal, 0, config.width / 2 - 0.5], [0, config.focal, config.height / 2 - 0.5], [0, 0, 1]])
    return Camera(K, se3.make(R_AHEAD, (0.27, 0.06, -0.08)), (config.width, config.height), name="image_2")


@lru_cache(maxsize=8)
def _rays(config: CameraConfig) -> Float:
    """(H, W, 3) unit directions of the pixels in the camera frame."""
    K = calibration(config).K
    v, u = np.indices((config.height, config.width)).astype(float)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def render(
    world: World, config: CameraConfig, T_world_cam: Array, time: float, rng: np.random.Generator, hours: float = 0.0
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of a world from a pose (4, 4) at a time, s; `rng` draws the pixel noise.

    `hours`: later in the day, with another position of the sun.
    """
    light = world.light.later(hours)
    eye = T_world_cam[:3, 3].astype(np.float32)
    dynamic_objects = world.traffic.dynamic_objects(time, eye)
    radiance = np.empty((config.height, config.width, 3), np.float32)
    for top in range(0, config.height, _BAND_ROWS):  # bands fit the processor's cache: a sixth less work
        rows = slice(top, min(top + _BAND_ROWS, config.height))
        view = rotated(_rays(config)[rows].reshape(-1, 3), T_world_cam[:3, :3])
        radiance[rows] = _render_band(world, light, dynamic_objects, eye, view, config).reshape(-1, config.width, 3)
    return through_lens(_develop(radiance, light.exposure, config.noise, rng), config)


def _render_band(
    world: World, light: Light, dynamic_objects: DynamicObjects | None, eye: Float, view: Float, config: CameraConfig
) -> Float:
    """(R, 3) light from the directions (R, 3) of some rows of pixels."""
    surface, seen, distance = _visible_points(world, dynamic_objects, eye, view, config)
    lit = np.ones(len(distance), np.float32)
    if not light.tunnel and light.overcast < 0.85:
        lit = _sunlit(world, light.sun, dynamic_objects, surface, seen, config.width)
    color = light.textures.albedo(surface, world.terrain)
    color *= light.shine(surface, lit)
    color[surface.material == Material.LAMP] = 1.3
    color -= _HAZE_COLOR
    color *= np.exp(distance / np.float32(-300 if light.tunnel else -900))[:, None]
    color += _HAZE_COLOR
    radiance = np.empty_like(view)
    radiance[seen] = color
    radiance[~seen] = light.sky(view[~seen])
    return radiance


def _visible_points(
    world: World, dynamic_objects: DynamicObjects | None, eye: Float, view: Float, config: CameraConfig
) -> tuple[VisiblePoints, NDArray[np.bool_], Float]:
    """The nearest surface points on the rays that hit one, static or moving; which rays hit; and their distances."""
    hits = world.scene.cast(np.broadcast_to(eye, view.shape).copy(), view, REACH)
    if dynamic_objects is not None:
        moving, toward = dynamic_objects.cast(eye, view, REACH)
        is_nearer = moving.distance < hits.distance[toward]
        moving_rays, moving = toward[is_nearer], moving.part(is_nearer)
        hits.distance[moving_rays], hits.normal[moving_rays] = moving.distance, moving.normal
    seen = np.isfinite(hits.distance)
    hits = hits.part(seen)
    columns = _attributes(world.static, hits)
    if dynamic_objects is not None:
        rows = np.cumsum(seen)[moving_rays] - 1
        for column, moving_values in zip(columns, _attributes(dynamic_objects.scene.mesh, moving), strict=True):
            column[rows] = moving_values
    uv, texture, material, color = columns
    direction, normal, distance = view[seen], hits.normal, hits.distance
    slope = np.einsum("ij,ij->i", normal, direction)
    scale = -np.sign(slope) / (np.sqrt(np.einsum("ij,ij->i", normal, normal)) + np.float32(1e-12))
    normal *= scale[:, None]
    footprint = distance / np.float32(config.focal) / np.sqrt(np.maximum(-slope * scale, np.float32(0.02)))
    position = direction * distance[:, None] + eye
    return (
        VisiblePoints(position, normal, direction, uv, texture, material, _TO_LINEAR[color], footprint),
        seen,
        distance,
    )


def _attributes(mesh: Mesh, hits: Hits) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """uv (R, 2), texture, material and color of the triangles hit; arbitrary values for rays that hit none."""
    face = np.maximum(hits.face, 0)
    corners = mesh.uv[face]
    uv = (1 - hits.u - hits.v)[:, None] * corners[:, 0]
    uv += hits.u[:, None] * corners[:, 1]
    uv += hits.v[:, None] * corners[:, 2]
    return uv, mesh.texture[face], mesh.material[face], mesh.color[face]


def _sunlit(
    world: World,
    sun: Float,
    dynamic_objects: DynamicObjects | None,
    surface: VisiblePoints,
    seen: NDArray[np.bool_],
    width: int,
) -> Float:
    """(P,) 0..1, from rays to the sun through every other pixel of every other row."""
    grid = np.full(seen.shape, -1, np.int32)
    grid[seen] = np.arange(len(surface.material), dtype=np.int32)
    sparse = grid.reshape(-1, width)[::2, ::2]
    point = sparse[sparse >= 0]
    origins = surface.position[point] + surface.normal[point] * np.float32(0.03)
    towards = np.broadcast_to(sun, origins.shape).copy()
    is_lit = world.scene.cast(origins, towards, 150.0).face < 0
    if dynamic_objects is not None:
        is_lit &= dynamic_objects.scene.cast(origins, towards, 150.0).face < 0
    half = np.ones(sparse.shape, np.float32)
    half[sparse >= 0] = is_lit
    full = cv2.resize(half, (width, len(seen) // width), interpolation=cv2.INTER_LINEAR)
    return full.reshape(-1)[seen]


def _develop(radiance: Float, exposure: float, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Apply automatic exposure, lens vignetting, and the sensor's response and noise."""
    height, width = radiance.shape[:2]
    v, u = (np.linspace(-1, 1, n, dtype=np.float32) for n in (height, width))
    vignette = 1 - 0.22 * (u[None] ** 2 * 0.8 + v[:, None] ** 2 * 0.2)
    gain = np.float32(exposure * 0.24 / (radiance[::4, ::4].mean() + 0.02))
    x = radiance * (vignette * gain)[..., None]
    x *= np.float32(4095) / (1 + x)  # compresses highlights
    image = _RESPONSE[x.astype(np.uint16)]
    image += rng.standard_normal(image.shape, np.float32) * np.float32(noise)
    return image.clip(0, 255).astype(np.uint8)
