# SPDX-License-Identifier: Apache-2.0
"""A spinning multi-beam LiDAR by ray casting: points, labels, and the twin of each scan without what moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dpm2_core.geometry import se3
from dpm2_core.sim.materials import DARK, MISS, MOVING_LABEL, REFLECTANCE, RETRO, ROUGHNESS, Label
from dpm2_core.sim.mesh import Hits, Mesh, rotated
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.shading import road_marking
from dpm2_core.sim.world import World

Array = NDArray[np.float64]
Float = NDArray[np.float32]

_CAR_BODY = (1.5, 1.67, 0.85, 0.56)
"""Edges of the roof ahead, behind and aside, and the sensor's height over it, m: hides what it hides on KITTI's car."""


def elevations(beams: int) -> Array:
    """(beams,) rad above the horizon, top beam first."""
    degrees = {
        16: np.linspace(15, -15, 16),
        32: np.linspace(10.67, -30.67, 32),
        64: np.concatenate([np.linspace(2, -8.33, 32), np.linspace(-8.83, -24.8, 32)]),
        128: np.linspace(15, -25, 128),
    }[beams]
    return np.radians(degrees)


@dataclass(eq=False)
class Scan:
    """One turn, by beam from the top, within a beam by azimuth from straight ahead to the left.

    Attributes:
        points: (N, 4) float32 [x, y, z in m, intensity 0..1] in the LiDAR frame.
        label: (N,) uint32 as in SemanticKITTI: class in the low 16 bits (252 and more where moving), number of the
            dynamic object in the high ones.
        moving: (N,) bool. ring: (N,) uint8, 0 is the top beam.
        time_offset: (N,) float32 s, from the middle of the turn.
        static: (M, 4) float32, what the same pulses return without anything that moves.
    """

    points: Float
    label: NDArray[np.uint32]
    moving: NDArray[np.bool_]
    ring: NDArray[np.uint8]
    time_offset: Float
    static: Float


class Lidar:
    """Scans worlds. Holds no state between scans: one may serve many threads."""

    def __init__(self, config: LidarConfig | None = None) -> None:
        self.config = config = config or LidarConfig()
        elevation = elevations(config.beams)[:, None]
        azimuth = np.arange(config.columns)[None] * (2 * np.pi / config.columns)
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth],
            -1,
        ).reshape(-1, 3)
        ring, column = np.divmod(np.arange(len(directions)), config.columns)
        if config.car_body:
            keep = ~_hidden_by_car(directions)
            directions, ring, column = directions[keep], ring[keep], column[keep]
        self.directions = np.ascontiguousarray(directions, np.float32)
        self.ring, self.column = ring.astype(np.uint8), column
        # No two laser-receiver pairs are equally sensitive.
        self.gain = np.random.default_rng(config.beams).normal(1, 0.12, config.beams).astype(np.float32)[ring]
        # It turns clockwise and looks straight ahead at the stamp.
        turn = -np.remainder(azimuth[0] + np.pi, 2 * np.pi) + np.pi
        self.column_time = (turn / (2 * np.pi) * config.period).astype(np.float32)

    def scan(
        self, world: World, T_world_lidar: Array, time: float, rng: np.random.Generator, twist: Array | None = None
    ) -> Scan:
        """One turn at a pose (4, 4).

        Args:
            time: s, where the dynamic objects are. They stand still during the turn.
            twist: (6,) [rad/s, m/s] of the sensor in its own frame during the turn: each point is then given in the
                frame of its own moment, as a driver delivers it. None: already corrected for motion, as KITTI's are.
        """
        origins, directions = self._rays(T_world_lidar, twist)
        chance = rng.random((2, len(directions)), np.float32)
        jitter = rng.standard_normal((2, len(directions)), np.float32)
        still = world.scene.cast(origins, directions, self.config.range)
        points, back = self._returns(world.static, still, directions, chance, jitter)
        label = world.static.label[np.maximum(still.face, 0)].astype(np.uint32)
        if not world.terrain.preset.degenerate:  # there, intensity would reveal the motion
            self._paint(world, T_world_lidar, points, label, back)
        static = points[back]
        moving = np.zeros(len(directions), bool)
        if dynamic_objects := world.dynamic_objects(time, T_world_lidar[:3, 3]):
            hits, toward = dynamic_objects.cast(
                origins if twist is not None else origins[0], directions, self.config.range
            )
            near = hits.distance < still.distance[toward]
            hits, which = hits.part(near), toward[near]
            moving[which] = True
            points[which], back[which] = self._returns(
                dynamic_objects.scene.mesh, hits, directions[which], chance[:, which], jitter[:, which], which
            )
            kind = MOVING_LABEL[dynamic_objects.scene.mesh.label[hits.face]]
            label[which] = kind | dynamic_objects.number[hits.face].astype(np.uint32) << 16
        time_offset = self.column_time[self.column[back]]
        return Scan(points[back], label[back], moving[back], self.ring[back], time_offset, static)

    def _paint(
        self, world: World, T_world_lidar: Array, points: Float, label: NDArray[np.uint32], back: NDArray[np.bool_]
    ) -> None:
        """Brightens and labels the returns from lane markings, in place."""
        road = np.flatnonzero(back & (label == Label.ROAD))
        xy = points[road, :3] @ T_world_lidar[:2, :3].T.astype(np.float32) + T_world_lidar[:2, 3].astype(np.float32)
        footprint = np.full(len(xy), 0.03, np.float32)
        painted = road[road_marking(*world.terrain.lane_coordinates(xy), footprint, world.terrain) > 0.5]
        label[painted] = Label.MARKING
        points[painted, 3] = np.minimum(points[painted, 3] * np.float32(1.7), 1)

    def _rays(self, T_world_lidar: Array, twist: Array | None) -> tuple[Float, Float]:
        if twist is None:
            directions = rotated(self.directions, T_world_lidar[:3, :3])
            return np.broadcast_to(T_world_lidar[:3, 3].astype(np.float32), directions.shape).copy(), directions
        T = T_world_lidar @ se3.exp(np.asarray(twist) * self.column_time[:, None].astype(float))
        R = T[:, :3, :3].astype(np.float32)[self.column]
        directions = np.einsum("nij,nj->ni", R, self.directions)
        return T[:, :3, 3].astype(np.float32)[self.column], directions

    def _returns(
        self,
        mesh: Mesh,
        hits: Hits,
        directions: Float,
        chance: Float,
        jitter: Float,
        which: NDArray[np.intp] | slice = slice(None),
    ) -> tuple[Float, NDArray[np.bool_]]:
        """Points (R, 4) in the LiDAR frame and whether each pulse came back (R,)."""
        config = self.config
        face = np.maximum(hits.face, 0)
        material = mesh.material[face]
        cosine = np.abs(np.einsum("ij,ij->i", hits.normal, directions))
        cosine /= np.sqrt(np.einsum("ij,ij->i", hits.normal, hits.normal)) + np.float32(1e-12)
        paint = mesh.color[face].sum(1, dtype=np.float32) / np.float32(3 * 150)
        reflectance = REFLECTANCE[material] * (np.float32(0.55) + np.float32(0.45) * np.minimum(paint, np.float32(1.6)))
        distance = np.where(hits.face >= 0, hits.distance, 0).astype(np.float32)
        # What is left of the pulse against what the receiver needs.
        strength = reflectance * (cosine + np.float32(0.02)) * (np.float32(30) / np.maximum(distance, 5)) ** 2
        # Whole panes and panels vanish rather than single pulses: half of the fraction is drawn once a quad.
        panel = ((face >> 1) * 40503 & 0xFFFF).astype(np.float32) / np.float32(0xFFFF)
        lost = config.dropout + MISS[material] * 2 * panel + np.exp(-strength / np.float32(0.006))
        back = (hits.face >= 0) & (chance[0] > lost)
        sigma = np.hypot(np.float32(config.noise), ROUGHNESS[material])
        measured = distance + sigma * jitter[0]
        back &= (measured >= config.min_range) & (measured <= config.range)
        points = np.empty((len(distance), 4), np.float32)
        points[:, :3] = self.directions[which] * measured[:, None]
        facing = np.where(RETRO[material], 1, 0.55 + 0.45 * np.sqrt(cosine)).astype(np.float32)
        intensity = reflectance * facing * np.exp(-distance / 160) * self.gain[which] + np.float32(0.03) * jitter[1]
        faint = DARK[material] + np.float32(0.6) / (1 + np.exp((np.float32(38) - distance) / 7))
        points[:, 3] = np.where(chance[1] < faint, 0, np.rint(intensity.clip(0, 1) * 100) / 100)
        return points, back


def _hidden_by_car(directions: Array) -> NDArray[np.bool_]:
    ahead, behind, aside, clearance = _CAR_BODY
    flat = np.hypot(directions[:, 0], directions[:, 1]) + 1e-9
    along, across = directions[:, 0] / flat, np.abs(directions[:, 1]) / flat
    reach = np.minimum(
        np.where(along > 0, ahead, behind) / np.maximum(np.abs(along), 1e-9), aside / np.maximum(across, 1e-9)
    )
    return -directions[:, 2] / flat * reach > clearance
