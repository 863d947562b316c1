# SPDX-License-Identifier: Apache-2.0
"""A world: streets, ground, what stands beside them, and what moves.

world = build_world("random", "suburb", seed=7)
T_world_lidar, time = world.sample_pose(np.random.default_rng(0))
scan = Lidar(LidarConfig()).scan(world, T_world_lidar, time, np.random.default_rng(1))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3
from dpm2_core.sim import sections
from dpm2_core.sim.config import PRESET_NAMES, PRESETS, Preset, PresetName, varied
from dpm2_core.sim.layout import Layout
from dpm2_core.sim.light import Light
from dpm2_core.sim.mesh import Hits, Mesh, Scene, merge
from dpm2_core.sim.road import Road, make_road
from dpm2_core.sim.terrain import Terrain
from dpm2_core.sim.traffic import Traffic, make_traffic

Array = NDArray[np.float64]
Float = NDArray[np.float32]


@dataclass(eq=False)
class World:
    """Everything a sensor can see. x and y are level, z up, m.

    Attributes:
        preset: its name. seed: with road and preset it determines the world. road, terrain, traffic: its parts.
        scene: what does not move, ready for ray casting. light: sun and sky.
    """

    preset: PresetName
    seed: int
    road: Road
    terrain: Terrain
    traffic: Traffic
    scene: Scene
    light: Light

    @property
    def static(self) -> Mesh:
        """The mesh of what does not move."""
        return self.scene.mesh

    def pose_at(self, s: float, lateral: float = 0.0, heading: float = 0.0, height: float = 1.73) -> Array:
        """T_world_lidar (4, 4) at arc length `s` m of the drive, `lateral` m to the left, turned by `heading` rad.

        The car stands on the ground under its wheels; the sensor is `height` m above it, x ahead, y left, z up.
        """
        (xy,), (yaw,) = self.road.drive.at(s, lateral)
        yaw = yaw + heading
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        feet = xy + np.array([1.4 * ahead, -1.4 * ahead, 0.8 * left, -0.8 * left])
        z = self.terrain.height_at(feet)
        x_axis = np.array([*(2.8 * ahead), z[0] - z[1]])
        y_axis = np.array([*(1.6 * left), z[2] - z[3]])
        z_axis = np.cross(x_axis, y_axis)
        R = np.stack([x_axis / np.linalg.norm(x_axis), np.zeros(3), z_axis / np.linalg.norm(z_axis)], -1)
        R[:, 1] = np.cross(R[:, 2], R[:, 0])
        return se3.make(R, np.array([*xy, z.mean()]) + height * R[:, 2])

    def drive_pose(self, time: float, height: float = 1.73) -> Array:
        """T_world_lidar (4, 4) of the drive at a time, s, with the small motions of its suspension."""
        t = time * 2 * np.pi
        sway = np.array([np.sin(0.9 * t) + 0.6 * np.sin(1.7 * t + 1), np.sin(1.1 * t + 2) + 0.5 * np.sin(2.3 * t), 0])
        bounce = 0.006 * np.sin(1.3 * t) + 0.004 * np.sin(2.1 * t + 1)
        T_body_lidar = se3.make(Rotation.from_rotvec(sway * (0.003, 0.004, 0)).as_matrix(), (0, 0, bounce))
        return self.pose_at(float(self.road.distance(time)), height=height) @ T_body_lidar

    def sample_pose(
        self, rng: np.random.Generator, lateral: float = 1.0, heading: float = 0.1, height: float = 1.73
    ) -> tuple[Array, float]:
        """T_world_lidar (4, 4) at a random place, up to `lateral` m and `heading` rad off the drive; its time, s."""
        time = float(rng.uniform(0, self.road.times[-1]))
        tilt = Rotation.from_rotvec([*rng.normal(0, 0.006, 2), 0]).as_matrix()
        T = self.pose_at(
            float(self.road.distance(time)),
            rng.uniform(-lateral, lateral),
            rng.uniform(-heading, heading),
            height + rng.normal(0, 0.01),
        )
        return T @ se3.make(tilt, np.zeros(3)), time

    def cast_movers(
        self, time: float, origins: Float, directions: Float, reach: float
    ) -> tuple[Mesh, NDArray[np.uint16], Hits, NDArray[np.intp]] | None:
        """What rays (R, 3) meet of the movers at a time, s.

        Returns:
            The movers' mesh and the number (F,) of the mover that each triangle belongs to; the hits of the K rays that
            point towards movers at all, and which (K,) rays these are. None if no mover is in sight.
        """
        movers = self.traffic.mesh(time, origins[0])
        if movers is None:
            return None
        mesh, instance = movers
        toward = _towards(mesh, origins[0], directions)
        hits = Scene(mesh).cast(origins[toward], directions[toward], reach)
        return mesh, instance, hits, toward


def build_world(road: str = "random", preset: PresetName = "city", seed: int = 0, length: float = 400.0) -> World:
    """A world, the same for the same arguments.

    Args:
        road: straight, loop, figure8, random, or a file of KITTI poses.
        preset: city, suburb, rural, highway or tunnel.
        length: of the road (a lap, where it is closed), m; a file has its own.

    Raises:
        UsageError: no such road or preset, or a length or seed that cannot be.
    """
    if not 60 <= length <= 20000:
        raise UsageError(f"length {length:g} m of road: want 60 to 20000")
    kind = own_preset(preset, seed)
    rngs = [random_stream(seed, preset, k) for k in range(4)]
    streets = make_road(road, kind, rngs[0], length)
    terrain = Terrain(streets, kind, rngs[1])
    meshes = [terrain.ground()]
    if preset == "highway":
        meshes += sections.clear(sections.highway(streets, terrain, rngs[2]), streets, terrain)
    elif preset == "tunnel":
        meshes += sections.clear(sections.tunnel(streets, terrain, rngs[2]), streets, terrain)
    else:
        meshes += Layout(streets, terrain, kind, rngs[2]).meshes()
    traffic = make_traffic(streets, terrain, kind, rngs[3])
    return World(preset, seed, streets, terrain, traffic, Scene(merge(meshes)), Light(seed, preset == "tunnel"))


def own_preset(preset: PresetName, seed: int) -> Preset:
    """The preset as the world of a seed has it.

    Raises:
        UsageError: no such preset, or a negative seed.
    """
    if preset not in PRESETS:
        raise UsageError(f"--preset {preset}: want one of {', '.join(PRESET_NAMES)}")
    if seed < 0:
        raise UsageError(f"--seed {seed}: want 0 or more")
    return varied(PRESETS[preset], random_stream(seed, preset, 4))


def random_stream(seed: int, preset: PresetName, part: int) -> np.random.Generator:
    """The random numbers of one part of a world: 0 roads, 1 terrain, 2 props, 3 traffic, 4 the preset's own values."""
    return np.random.default_rng([seed, PRESET_NAMES.index(preset), part])


def _towards(mesh: Mesh, origin: Float, directions: Float) -> NDArray[np.intp]:
    """Which rays (R, 3) lie within the azimuths and elevations that a mesh covers as seen from a point (3,)."""
    bins = 720
    away = mesh.vertices - origin
    flat = np.hypot(away[:, 0], away[:, 1]) + np.float32(1e-3)
    corners = np.arctan2(away[:, 1], away[:, 0])[mesh.faces]
    spread = np.remainder(corners - corners[:, :1] + np.pi, 2 * np.pi) - np.pi
    first = np.floor((corners[:, 0] + spread.min(1) - 0.01) / (2 * np.pi) * bins).astype(int)
    last = np.floor((corners[:, 0] + spread.max(1) + 0.01) / (2 * np.pi) * bins).astype(int)
    # +1 where a triangle begins, -1 after its end, over three turns folded into one
    steps = np.bincount(first + bins, minlength=3 * bins + 1) - np.bincount(last + bins + 1, minlength=3 * bins + 1)
    covered = np.cumsum(steps)[: 3 * bins].reshape(3, bins).max(0) > 0
    slope = directions[:, 2] / (np.hypot(directions[:, 0], directions[:, 1]) + np.float32(1e-6))
    low, high = (away[:, 2] / flat).min() - 0.02, (away[:, 2] / flat).max() + 0.02
    azimuth = np.floor(np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) * bins).astype(int) % bins
    return np.flatnonzero(covered[azimuth] & (slope > low) & (slope < high))
