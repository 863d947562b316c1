# SPDX-License-Identifier: Apache-2.0
"""Errors of a real LiDAR added to exact ranges: of its beams, the pulse, the window and the air."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.sim.mesh import Float
from dpm2_core.sim.settings import LidarConfig

Bool = NDArray[np.bool_]
_EDGE_GAP = (0.2, 1.5)
"""Two surfaces this far apart along the beam, m, can give a single return from between them."""
_GLARE_RADIUS = 2
"""Beams and columns next to a retro-reflector that its glare reaches."""
_MAX_DROP_RANGE = 25.0
"""Drops farther away than this, m, return too little."""


@dataclass(eq=False)
class Returns:
    """Returns of R pulses.

    Attributes:
        distance: (R,) float32 m to the surface hit, even if it gives no return; the LiDAR's range if there is none.
        intensity: (R,) float32 0..1. returned: (R,) bool, whether there is a return.
        retro: (R,) bool, whether it hit a retro-reflector.
    """

    distance: Float
    intensity: Float
    returned: Bool
    retro: Bool

    def copy(self) -> Returns:
        """A copy with its own arrays."""
        return Returns(*(getattr(self, field.name).copy() for field in fields(self)))

    def put(self, indices: NDArray[np.intp], others: Returns) -> None:
        """Replace the returns of K pulses, with `indices` (K,), by `others`."""
        for field in fields(self):
            getattr(self, field.name)[indices] = getattr(others, field.name)


class Draws(NamedTuple):
    """Random numbers (R,) of one scan for edges, glare and drops; the static twin has the same weather."""

    edge: Float
    halo: Float
    drop: Float


class SensorErrors:
    """Errors of one sensor, determined by its serial number; stateless between scans.

    Attributes:
        range_bias: (R,) m. origin_height: (R,) m above the sensor. transmission: (R,) fraction of the light that
            passes the window.
    """

    def __init__(self, config: LidarConfig, ring: NDArray[np.uint8], column: NDArray[np.intp]) -> None:
        self.config, self.settings = config, config.real
        self.ring, self.column = ring, column
        real, beams = config.real, config.beams
        rng = np.random.default_rng([real.serial, beams, 2])
        self.range_bias = (real.range_bias * rng.standard_normal(beams)).astype(np.float32)[ring]
        self._angles = np.radians(real.angle_bias * rng.standard_normal((2, beams))).astype(np.float32)
        upper, lower = real.emitters
        self.origin_height = np.where(ring < beams // 2, upper, lower).astype(np.float32)
        self.transmission = self._window(rng)[ring, column]

    def _window(self, rng: np.random.Generator) -> Float:
        """(beams, columns) fraction of the light that passes: spots of dirt, each some degrees wide."""
        shape = (self.config.beams, self.config.columns)
        if not self.settings.dirt:
            return np.ones(shape, np.float32)
        spots = cv2.resize(rng.standard_normal((6, 48)).astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
        limit = np.quantile(spots, 1 - self.settings.dirt)
        return np.exp(-4 * np.maximum(spots - limit, 0) / max(float(spots.std()), 1e-6)).astype(np.float32)

    def aimed(self, directions: Float) -> Float:
        """True directions of the pulses that the driver assumes to have the directions (R, 3)."""
        if not self.settings.angle_bias:
            return directions
        up, left = (row[self.ring, None] for row in self._angles)
        x, y, z = directions.T
        flat = np.sqrt(x * x + y * y) + np.float32(1e-6)
        turned = directions + left * np.stack([-y, x, np.zeros_like(x)], -1)
        turned += up * np.stack([-x * z / flat, -y * z / flat, flat], -1)
        return turned / np.linalg.norm(turned, axis=1, keepdims=True)

    def noise(self, distance: Float, cosine: Float) -> Float:
        """(R,) standard deviation added to that of the ranges (R,) m: it grows with range and grazing incidence."""
        tangent = np.sqrt(1 - np.minimum(cosine, 1) ** 2) / np.maximum(cosine, np.float32(0.05))
        slanted = np.minimum(np.float32(0.04 * self.settings.footprint) * distance * tangent, np.float32(0.2))
        return np.hypot(np.float32(self.settings.growth) * distance, slanted)

    def draws(self, rng: np.random.Generator) -> Draws | None:
        """The random numbers for `finish`, None if it has nothing to do."""
        real = self.settings
        if not (real.footprint or real.glare or real.drops):
            return None
        return Draws(*rng.random((3, len(self.ring)), np.float32))

    def finish(self, returns: Returns, draws: Draws | None) -> Bool:
        """Apply edges, glare and drops to a whole scan in place; the result (R,) marks returns of no surface."""
        stray = np.zeros(len(self.ring), bool)
        if draws is None:
            return stray
        distance, intensity, returned, retro = returns.distance, returns.intensity, returns.returned, returns.retro
        if self.settings.footprint:
            self._mix_edges(distance, returned, draws.edge)
        if self.settings.glare:
            stray |= self._glare(distance, intensity, returned, retro, draws.halo)
        if self.settings.drops:
            stray |= self._drops(distance, intensity, returned, draws.drop)
        return stray

    def _mix_edges(self, distance: Float, returned: Bool, chance: Float) -> None:
        """Move returns of pulses that hit two surfaces to between them."""
        difference = np.diff(distance, append=distance[-1:])
        gap = np.abs(difference)
        step = 2 * np.pi / self.config.columns
        is_pair = returned & np.append(returned[1:], False) & np.append(self.ring[1:] == self.ring[:-1], False)
        share = min(0.5, self.settings.footprint / step)
        mixed = is_pair & (gap > _EDGE_GAP[0]) & (gap < _EDGE_GAP[1]) & (chance < share)
        distance[mixed] += difference[mixed] * (chance[mixed] / np.float32(share))

    def _glare(self, distance: Float, intensity: Float, returned: Bool, retro: Bool, chance: Float) -> Bool:
        """Make pulses next to a retro-reflector, with nothing nearer, return at its distance."""
        retro_distance = np.full((self.config.beams, self.config.columns), np.inf, np.float32)
        retro_returns = np.flatnonzero(retro & returned)
        retro_distance[self.ring[retro_returns], self.column[retro_returns]] = distance[retro_returns]
        halo = cv2.erode(
            retro_distance, np.ones((2 * _GLARE_RADIUS + 1, 2 * _GLARE_RADIUS + 1), np.uint8), borderValue=float("inf")
        )
        glare_distance = halo[self.ring, self.column]
        is_glare = np.isfinite(glare_distance) & ~retro & (chance < self.settings.glare) & (distance > glare_distance)
        distance[is_glare], intensity[is_glare], returned[is_glare] = glare_distance[is_glare], np.float32(0.3), True
        return is_glare

    def _drops(self, distance: Float, intensity: Float, returned: Bool, chance: Float) -> Bool:
        """Rain, snow or dust: pulses that return from a drop before they reach a surface."""
        density = np.float32(self.settings.drops)
        # m, for a constant density along the beam
        drop_distance = -np.log(np.maximum(chance, np.float32(1e-7))) / density
        hit = (drop_distance < np.minimum(distance, _MAX_DROP_RANGE)) & (drop_distance > self.config.min_range)
        distance[hit], intensity[hit], returned[hit] = drop_distance[hit], np.float32(0.02), True
        return hit
