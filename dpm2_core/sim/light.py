# SPDX-License-Identifier: Apache-2.0
"""Light sources of an image: sun, sky and lamps."""

from __future__ import annotations

import copy

import numpy as np

from dpm2_core.sim.materials import Material
from dpm2_core.sim.mesh import Float
from dpm2_core.sim.shading import Textures, VisiblePoints


class Light:
    """Sun and sky of a world, from its seed; in a tunnel only the lamps.

    Attributes:
        sun: (3,) unit vector towards it. overcast: 0..1. exposure: of the camera, about 1.
        textures: of surfaces and clouds.
    """

    def __init__(self, seed: int, tunnel: bool) -> None:
        rng = np.random.default_rng([seed, 78])
        elevation, azimuth = np.radians(rng.uniform(22, 60)), rng.uniform(0, 2 * np.pi)
        self.sun = _direction(elevation, azimuth)
        self.overcast = float(rng.beta(0.5, 1.2))
        warm = np.array([1.0, 0.95, 0.86], np.float32)
        self.direct = warm * np.float32(2.1 * (1 - 0.9 * self.overcast))
        self.ambient = np.array([0.36, 0.41, 0.48], np.float32) * np.float32(1 + 1.2 * self.overcast)
        self.tunnel = tunnel
        self.exposure = float(rng.uniform(0.85, 1.2))
        self.textures = Textures(seed)

    def later(self, hours: float) -> Light:
        """The same day some hours later: the sun moves 15 deg and sinks 5 deg per hour, 8 to 75 deg high."""
        if not hours or self.tunnel:
            return self
        out = copy.copy(self)
        elevation = np.clip(np.arcsin(self.sun[2]) - np.radians(5 * hours), np.radians(8), np.radians(75))
        azimuth = np.arctan2(self.sun[1], self.sun[0]) - np.radians(15 * hours)
        out.sun = _direction(elevation, azimuth)
        return out

    def sky(self, view: Float) -> Float:
        """(P, 3) color of the sky along directions (P, 3): a gradient, clouds, and the glow around the sun."""
        if self.tunnel:
            return np.full((len(view), 3), 1.4, np.float32)
        up = np.clip(view[:, 2], 0.0, 1)[:, None]
        blue = np.array([0.62, 0.76, 0.95], np.float32) * (1 - up) + np.array([0.22, 0.42, 0.85], np.float32) * up
        plane = view[:, :2] / (view[:, 2:] + np.float32(0.12))
        cloud = self.textures.noise(plane, 1.9) + 0.5 * self.textures.noise(plane + 1, 0.8)
        cloud += 0.25 * self.textures.noise(plane + 2, 0.3)
        cover = np.clip(0.5 * cloud - 0.5 + 1.6 * self.overcast, 0, 1)[:, None]
        gray = np.array([0.86, 0.87, 0.9], np.float32) * np.clip(0.9 + 0.1 * cloud[:, None], 0.6, 1.2)
        glow = np.exp((view @ self.sun - 1) * 12)[:, None] * (1 - 0.7 * self.overcast)
        return 1.5 * (blue * (1 - cover) + gray * cover) + glow

    def shine(self, surface: VisiblePoints, lit: Float) -> Float:
        """(P, 3) light on each point; `lit` (P,) is the share of the sunlight that reaches it."""
        if self.tunnel:
            falloff = 0.35 + 0.5 * np.clip(-surface.normal[:, 2] * 0.3 + np.abs(surface.normal[:, 2]), 0, 1)
            return falloff[:, None] * np.array([1.15, 1.0, 0.78], np.float32)
        facing = np.clip(surface.normal @ self.sun, 0, 1) * lit
        leaf = surface.material == Material.LEAF  # lit from both sides
        facing = np.where(leaf, 0.35 * lit + 0.5 * facing, facing)
        open_sky = 0.6 + 0.4 * surface.normal[:, 2]
        return facing[:, None] * self.direct + open_sky[:, None] * self.ambient


def _direction(elevation: float, azimuth: float) -> Float:
    """(3,) unit vector in a direction; both angles in rad."""
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], np.float32)
