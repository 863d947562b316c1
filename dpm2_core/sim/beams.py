# SPDX-License-Identifier: Apache-2.0
"""Directions of a LiDAR's pulses: patterns of spinning sensors, and of a non-repeating one with two prisms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.trajectory import FRAME_PERIOD
from dpm2_core.frame import Array
from dpm2_core.sim.mesh import Float
from dpm2_core.sim.settings import LidarConfig

_CAR_BODY = (1.5, 1.67, 0.85, 0.56)
"""Roof edges ahead, behind and to the side, and the sensor's height above it, m: occludes the same as KITTI's car."""
_PRISMS = ((7294 / 60, np.radians(17.6)), (-4664 / 60, np.radians(17.6)))
"""Revolutions per second and deflection, rad, of the two prisms of the rosette, as in Livox' Mid-40 and Avia."""
_LASER_SPACING = np.radians(0.28)
"""Angle between two lasers of the rosette, rad."""


def elevations(beams: int) -> Array:
    """(beams,) elevations of a spinning sensor, rad, top beam first."""
    degrees = {
        16: np.linspace(15, -15, 16),
        32: np.linspace(10.67, -30.67, 32),
        64: np.concatenate([np.linspace(2, -8.33, 32), np.linspace(-8.83, -24.8, 32)]),
        128: np.linspace(15, -25, 128),
    }[beams]
    return np.radians(degrees)


class Beams:
    """The pulses of a revolution (for the rosette, of a period), ordered by beam, within a beam by column.

    Attributes:
        ring, column: (R,) beam, 0 is the top one, and number of the firing.
        column_time: (columns,) float32 s from the stamp.
    """

    def __init__(self, config: LidarConfig, T_level_lidar: Array) -> None:
        self.config = config
        self._is_spinning = config.pattern == "spinning"
        n = config.columns
        ring, column = np.divmod(np.arange(config.beams * n), n)
        self._kept: NDArray[np.bool_] | slice = slice(None)
        self._fixed_directions: Float | None = None  # constant directions of a spinning sensor
        if self._is_spinning:
            directions = self._spinning_directions()
            if config.car_body:
                self._kept = ~_hidden_by_car(directions @ T_level_lidar[:3, :3].T)
            self._fixed_directions = np.ascontiguousarray(directions[self._kept], np.float32)
        self.ring, self.column = ring.astype(np.uint8)[self._kept], column[self._kept]
        azimuth = np.arange(n) * (2 * np.pi / n)
        # A spinning sensor rotates clockwise and faces straight ahead at the stamp.
        phase = -np.remainder(azimuth + np.pi, 2 * np.pi) + np.pi if self._is_spinning else azimuth - np.pi
        self.column_time = (phase / (2 * np.pi) * FRAME_PERIOD).astype(np.float32)

    def directions(self, time: float) -> Float:
        """(R, 3) unit directions in the LiDAR frame of the revolution at a time, s."""
        return self._rosette_directions(time) if self._fixed_directions is None else self._fixed_directions

    def _spinning_directions(self) -> Array:
        config = self.config
        angle = elevations(config.beams)
        if config.real.uneven:
            rng = np.random.default_rng([config.real.serial, config.beams, 1])
            angle = angle + np.radians(config.real.uneven) * rng.standard_normal(config.beams)
        elevation, azimuth = angle[:, None], np.arange(config.columns)[None] * (2 * np.pi / config.columns)
        parts = (
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        )
        return np.stack(parts, -1).reshape(-1, 3)

    def _rosette_directions(self, time: float) -> Float:
        """A row of lasers behind two counter-rotating prisms: the sum of two deflections, which does not repeat."""
        times = time + self.column_time.astype(float)
        left, up = (
            sum(bend * wave(2 * np.pi * rate * times) for rate, bend in _PRISMS) for wave in (np.cos, np.sin)
        )  # rad
        laser = (0.5 * (self.config.beams - 1) - np.arange(self.config.beams)) * _LASER_SPACING
        y = np.tan(np.broadcast_to(left, (self.config.beams, len(times))))
        z = np.tan(np.add.outer(laser, up))
        rays = np.stack([np.ones_like(y), y, z], -1).reshape(-1, 3)
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def _hidden_by_car(directions: Array) -> NDArray[np.bool_]:
    ahead, behind, aside, clearance = _CAR_BODY
    flat = np.hypot(directions[:, 0], directions[:, 1]) + 1e-9
    along, across = directions[:, 0] / flat, np.abs(directions[:, 1]) / flat
    reach = np.minimum(
        np.where(along > 0, ahead, behind) / np.maximum(np.abs(along), 1e-9), aside / np.maximum(across, 1e-9)
    )
    return -directions[:, 2] / flat * reach > clearance
