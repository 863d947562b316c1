# SPDX-License-Identifier: Apache-2.0
"""A multi-beam LiDAR simulated by ray casting: points, labels, and the twin of each scan without moving objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.deskew import deskew
from dpm2_core.sim.beams import Beams
from dpm2_core.sim.imperfections import Returns, SensorErrors
from dpm2_core.sim.materials import DARK, MISS, MOVING_LABEL, REFLECTANCE, RETRO, ROUGHNESS, Label
from dpm2_core.sim.mesh import Float, Hits, Mesh, rotated
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.shading import road_marking
from dpm2_core.sim.world import World


@dataclass(eq=False)
class Scan:
    """One revolution, ordered by beam from the top, within a beam by azimuth from straight ahead to the left.

    Attributes:
        points: (N, 4) float32 [x, y, z in m, intensity 0..1] in the LiDAR frame.
        label: (N,) uint32 as in SemanticKITTI: class in the low 16 bits (252 and more if moving), number of the
            dynamic object in the high ones.
        ring: (N,) uint8, 0 is the top beam.
        time_offset: (N,) float32 s, from the middle of the revolution.
        static: (M, 4) float32, returns of the same pulses without any moving object.
    """

    points: Float
    label: NDArray[np.uint32]
    ring: NDArray[np.uint8]
    time_offset: Float
    static: Float

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(N,) whether a point is on a dynamic object."""
        return self.label >> 16 > 0


class Lidar:
    """Scans worlds. Stateless between scans: one instance may be used by many threads.

    Attributes:
        T_level_lidar: (4, 4) of its mount, a pure rotation.
    """

    def __init__(self, config: LidarConfig | None = None) -> None:
        self.config = config = config or LidarConfig()
        turn = Rotation.from_euler("xy", (config.roll, config.pitch), degrees=True)
        self.T_level_lidar = se3.make(turn.as_matrix(), np.zeros(3))
        self.beams = Beams(config, self.T_level_lidar)
        self.errors = SensorErrors(config, self.beams.ring, self.beams.column)
        # Every laser-receiver pair has its own sensitivity.
        gain = np.random.default_rng(config.beams).normal(1, 0.12, config.beams).astype(np.float32)
        self.gain = gain[self.beams.ring]

    def scan(
        self,
        world: World,
        T_world_lidar: Array,
        time: float,
        rng: np.random.Generator,
        twist: Array | None = None,
        deskew_twist: Array | None = None,
    ) -> Scan:
        """One revolution at a pose (4, 4).

        Args:
            time: s, for the positions of the dynamic objects. They do not move during the revolution.
            twist: (6,) [rad/s, m/s] of the sensor in its own frame during the revolution, or its poses (columns, 4, 4)
                T_stamp_column at the times of the columns: each point is then in the sensor frame at its own time, as
                in a driver's raw cloud. None: already de-skewed, as KITTI's are.
            deskew_twist: (6,) twist used to de-skew the points of a revolution in motion.
        """
        aim = self.beams.directions(time)
        origins, directions = self._rays(T_world_lidar, self.errors.aimed(aim), twist)
        chance = rng.random((2, len(directions)), np.float32)
        jitter = rng.standard_normal((2, len(directions)), np.float32)
        draws = self.errors.draws(rng)
        static_hits = world.scene.cast(origins, directions, self.config.range)
        returns = self._returns(world.static, static_hits, directions, chance, jitter)
        label = world.static.label[np.maximum(static_hits.face, 0)].astype(np.uint32)
        if not world.terrain.preset.degenerate:  # there the intensity would show the motion
            self._mark_lanes(world, T_world_lidar, aim, returns, label)
        static_returns = returns.copy()
        self.errors.finish(static_returns, draws)
        static = self._points(aim, static_returns, deskew_twist)
        if dynamic_objects := world.traffic.dynamic_objects(time, T_world_lidar[:3, 3]):
            single_origin = twist is None and not any(self.config.real.emitters)
            hits, toward = dynamic_objects.cast(origins[0] if single_origin else origins, directions, self.config.range)
            is_nearer = hits.distance < static_hits.distance[toward]
            hits, rays = hits.part(is_nearer), toward[is_nearer]
            mesh = dynamic_objects.scene.mesh
            moving_returns = self._returns(mesh, hits, directions[rays], chance[:, rays], jitter[:, rays], rays)
            returns.put(rays, moving_returns)
            number = dynamic_objects.number[hits.face].astype(np.uint32)
            label[rays] = MOVING_LABEL[mesh.label[hits.face]] | number << 16
        stray = self.errors.finish(returns, draws)
        label[stray] = Label.OUTLIER
        returned = returns.returned
        time_offset = self.beams.column_time[self.beams.column[returned]]
        points = self._points(aim, returns, deskew_twist)
        return Scan(points, label[returned], self.beams.ring[returned], time_offset, static)

    def pose(self, world: World, time: float) -> Array:
        """T_world_lidar (4, 4) of the mounted sensor at a time of the drive, s."""
        return world.drive_pose(time, self.config.height, self.config.real.sway) @ self.T_level_lidar

    def drive_scan(self, world: World, T_world_lidar: Array, time: float, rng: np.random.Generator) -> Scan:
        """One revolution at a pose (4, 4) and time, s, with the drive's motion and the de-skewing error of a driver
        (`Imperfections.skew`)."""
        if not self.config.real.skew:
            return self.scan(world, T_world_lidar, time, rng)
        twist = world.drive_twist(time, self.config.height, self.config.real.sway)
        sensor_twist = (twist.reshape(2, 3) @ self.T_level_lidar[:3, :3]).ravel()
        return self.scan(
            world, T_world_lidar, time, rng, sensor_twist, sensor_twist * (1 + self.config.real.skew * rng.normal())
        )

    def _mark_lanes(
        self, world: World, T_world_lidar: Array, aim: Float, returns: Returns, label: NDArray[np.uint32]
    ) -> None:
        """Brighten and label the returns from lane markings, in place."""
        road = np.flatnonzero(returns.returned & (label == Label.ROAD))
        points = aim[road] * returns.distance[road, None]
        xy = points @ T_world_lidar[:2, :3].T.astype(np.float32) + T_world_lidar[:2, 3].astype(np.float32)
        footprint = np.full(len(xy), 0.03, np.float32)
        painted = road[road_marking(*world.terrain.lane_coordinates(xy), footprint, world.terrain) > 0.5]
        label[painted] = Label.MARKING
        returns.intensity[painted] = np.minimum(returns.intensity[painted] * np.float32(1.7), 1)

    def _rays(self, T_world_lidar: Array, aim: Float, twist: Array | None) -> tuple[Float, Float]:
        """Origins and directions (R, 3) in the world frame."""
        height = self.errors.origin_height[:, None]
        if twist is None:
            directions = rotated(aim, T_world_lidar[:3, :3])
            origin = T_world_lidar[:3, 3].astype(np.float32)
            return origin + height * T_world_lidar[:3, 2].astype(np.float32), directions
        motion = np.asarray(twist)
        T_stamp_column = se3.exp(motion * self.beams.column_time[:, None].astype(float)) if motion.ndim == 1 else motion
        T = T_world_lidar @ T_stamp_column
        R = T[:, :3, :3].astype(np.float32)[self.beams.column]
        directions = np.einsum("nij,nj->ni", R, aim)
        return T[:, :3, 3].astype(np.float32)[self.beams.column] + height * R[:, :, 2], directions

    def _points(self, aim: Float, returns: Returns, deskew_twist: Array | None) -> Float:
        """(N, 4) of the pulses that returned, de-skewed to the stamp with `deskew_twist`, if given."""
        returned = returns.returned
        points = np.empty((int(returned.sum()), 4), np.float32)
        points[:, :3] = aim[returned] * returns.distance[returned, None]
        points[:, 2] += self.errors.origin_height[returned]
        points[:, 3] = returns.intensity[returned]
        if deskew_twist is None:
            return points
        return deskew(points, self.beams.column_time[self.beams.column[returned]], deskew_twist)

    def _returns(
        self,
        mesh: Mesh,
        hits: Hits,
        directions: Float,
        chance: Float,
        jitter: Float,
        rays: NDArray[np.intp] | slice = slice(None),
    ) -> Returns:
        """Returns of the pulses (R,) on a mesh, given their hits."""
        config, real = self.config, self.config.real
        face = np.maximum(hits.face, 0)
        material = mesh.material[face]
        cosine = np.abs(np.einsum("ij,ij->i", hits.normal, directions))
        cosine /= np.sqrt(np.einsum("ij,ij->i", hits.normal, hits.normal)) + np.float32(1e-12)
        paint = mesh.color[face].sum(1, dtype=np.float32) / np.float32(3 * 150)
        reflectance = REFLECTANCE[material] * (np.float32(0.55) + np.float32(0.45) * np.minimum(paint, np.float32(1.6)))
        distance = np.where(hits.face >= 0, hits.distance, config.range).astype(np.float32)
        # Strength of the returned pulse relative to the receiver's threshold.
        strength = reflectance * (cosine + np.float32(0.02)) * (np.float32(30) / np.maximum(distance, 5)) ** 2
        strength *= self.errors.transmission[rays]
        # Whole panes and panels vanish rather than single pulses: half of the fraction is drawn once per quad.
        panel = ((face >> 1) * 40503 & 0xFFFF).astype(np.float32) / np.float32(0xFFFF)
        absorbed = panel < MISS[material] if real.panes else MISS[material] * 2 * panel
        loss = config.dropout + absorbed + np.exp(-strength / np.float32(0.006 * (1 + real.weak)))
        returned = (hits.face >= 0) & (chance[0] > loss)
        sigma = np.hypot(np.float32(config.noise), ROUGHNESS[material])
        if real.growth or real.footprint:
            sigma = np.hypot(sigma, self.errors.noise(distance, cosine))
        measured = distance + sigma * jitter[0] + self.errors.range_bias[rays]
        returned &= (measured >= config.min_range) & (measured <= config.range)
        facing = np.where(RETRO[material], 1, 0.55 + 0.45 * np.sqrt(cosine)).astype(np.float32)
        intensity = reflectance * facing * np.exp(-distance / 160) * self.gain[rays] * self.errors.transmission[rays]
        intensity += np.float32(0.03) * jitter[1]
        faint = DARK[material] + np.float32(0.6) / (1 + np.exp((np.float32(38) - distance) / 7))
        intensity = np.where(chance[1] < faint, 0, np.rint(intensity.clip(0, 1) * 100) / 100).astype(np.float32)
        return Returns(measured, intensity, returned, RETRO[material])
