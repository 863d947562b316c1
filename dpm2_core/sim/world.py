# SPDX-License-Identifier: Apache-2.0
"""A world: streets, ground, static objects next to them, and moving objects.

world = build_world("random", "suburb", seed=7)
T_world_lidar, time = world.sample_pose(np.random.default_rng(0))
scan = Lidar(LidarConfig()).scan(world, T_world_lidar, time, np.random.default_rng(1))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.sim import sections
from dpm2_core.sim.indoor import Interior
from dpm2_core.sim.layout import Layout
from dpm2_core.sim.light import Light
from dpm2_core.sim.mesh import Mesh, Scene, merge
from dpm2_core.sim.road import Road, make_road
from dpm2_core.sim.settings import PRESET_NAMES, PRESETS, Preset, PresetName, varied, with_traffic
from dpm2_core.sim.terrain import Terrain
from dpm2_core.sim.traffic import Traffic, make_traffic


@dataclass(eq=False)
class World:
    """Everything that sensors can measure. x and y are horizontal, z up, m.

    Attributes:
        preset: its name. seed: with road and preset it determines the world. road, terrain, traffic: its parts.
        scene: static objects, ready for ray casting. light: sun and sky.
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
        """The mesh of the static objects."""
        return self.scene.mesh

    def pose_at(self, s: float, lateral: float = 0.0, heading: float = 0.0, height: float = 1.73) -> Array:
        """T_world_lidar (4, 4) at arc length `s` m of the drive, `lateral` m to the left, rotated by `heading` rad.

        The car stands on the ground under its wheels; the sensor is `height` m above it, x ahead, y left, z up.
        """
        (xy,), (yaw,) = self.road.drive.at(s, lateral)
        yaw = yaw + heading
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        wheels = xy + np.array([1.4 * ahead, -1.4 * ahead, 0.8 * left, -0.8 * left])
        z = self.terrain.height_at(wheels)
        x_axis = np.array([*(2.8 * ahead), z[0] - z[1]])
        y_axis = np.array([*(1.6 * left), z[2] - z[3]])
        z_axis = np.cross(x_axis, y_axis)
        R = np.stack([x_axis / np.linalg.norm(x_axis), np.zeros(3), z_axis / np.linalg.norm(z_axis)], -1)
        R[:, 1] = np.cross(R[:, 2], R[:, 0])
        return se3.make(R, np.array([*xy, z.mean()]) + height * R[:, 2])

    def drive_pose(self, time: float, height: float = 1.73, sway: float = 1.0) -> Array:
        """T_world_lidar (4, 4) of the drive at a time, s; `sway` is a factor on the small motions of its suspension."""
        t = time * 2 * np.pi
        turn = np.array([np.sin(0.9 * t) + 0.6 * np.sin(1.7 * t + 1), np.sin(1.1 * t + 2) + 0.5 * np.sin(2.3 * t), 0])
        bounce = sway * (0.006 * np.sin(1.3 * t) + 0.004 * np.sin(2.1 * t + 1))
        T_body_lidar = se3.make(Rotation.from_rotvec(sway * turn * (0.003, 0.004, 0)).as_matrix(), (0, 0, bounce))
        return self.pose_at(float(self.road.distance(time)), 0.0, self.road.slip_at(time), height) @ T_body_lidar

    def drive_twist(self, time: float, height: float, sway: float) -> Array:
        """(6,) [rad/s, m/s] of the sensor in its own frame at a time of the drive, s."""
        before, after = (self.drive_pose(time + half, height, sway) for half in (-0.02, 0.02))
        return se3.way(before, after) / 0.04

    def sample_pose(
        self,
        rng: np.random.Generator,
        heading: float = 0.1,
        height: float = 1.73,
        sway: float = 1.0,
    ) -> tuple[Array, float]:
        """T_world_lidar (4, 4) at a random position, up to 1 m (indoors 0.15 m) and `heading` rad off the drive; its
        time, s. It is tilted as much as by the suspension, times `sway`."""
        lateral = 0.15 if self.road.plan else 1.0
        time = float(rng.uniform(0, self.road.times[-1]))
        tilt = Rotation.from_rotvec([*rng.normal(0, 0.006 * sway, 2), 0]).as_matrix()
        T = self.pose_at(
            float(self.road.distance(time)),
            rng.uniform(-lateral, lateral),
            rng.uniform(-heading, heading),
            height + rng.normal(0, 0.01),
        )
        return T @ se3.make(tilt, np.zeros(3)), time


def build_world(
    road: str = "random", preset: PresetName = "city", seed: int = 0, length: float = 400.0, traffic: float = 1.0
) -> World:
    """A world, identical for identical arguments.

    Args:
        road: straight, loop, figure8, random, or a file of KITTI poses.
        preset: city, suburb, rural, highway, tunnel, indoor or car_park.
        length: of the road (a lap, if it is closed), m; a file has its own length.
        traffic: factor on that of the preset; see `with_traffic`.

    Raises:
        UsageError: no such road or preset, or an invalid length, seed or traffic.
    """
    if not 60 <= length <= 20000:
        raise UsageError(f"length {length:g} m of road: want 60 to 20000")
    kind = own_preset(preset, seed, traffic)
    rngs = [random_stream(seed, preset, k) for k in range(4)]
    streets = make_road(road, kind, rngs[0], length)
    terrain = Terrain(streets, kind, rngs[1])
    meshes = [terrain.ground()] if streets.plan is None else []
    if streets.plan is not None:
        meshes += Interior(streets.plan, streets.drive.xy, rngs[2]).meshes()
    elif preset == "highway":
        meshes += sections.clear(sections.highway(streets, terrain, rngs[2]), streets, terrain)
    elif preset == "tunnel":
        meshes += sections.clear(sections.tunnel(streets, terrain, rngs[2]), streets, terrain)
    else:
        meshes += Layout(streets, terrain, kind, rngs[2]).meshes()
    moving = make_traffic(streets, terrain, kind, rngs[3])
    return World(
        preset,
        seed,
        streets,
        terrain,
        moving,
        Scene(merge(meshes)),
        Light(seed, bool(kind.indoor) or preset == "tunnel"),
    )


def own_preset(preset: PresetName, seed: int, traffic: float = 1.0) -> Preset:
    """The preset with the values of the world with that seed, and with its traffic scaled.

    Raises:
        UsageError: no such preset, or an invalid seed or traffic.
    """
    if preset not in PRESETS:
        raise UsageError(f"--preset {preset}: want one of {', '.join(PRESET_NAMES)}")
    if seed < 0:
        raise UsageError(f"--seed {seed}: want 0 or more")
    own = varied(PRESETS[preset], random_stream(seed, preset, 4))
    return with_traffic(own, PRESETS[preset], traffic)


def random_stream(seed: int, preset: PresetName, part: int) -> np.random.Generator:
    """The random numbers of one part of a world: 0 roads, 1 terrain, 2 props, 3 traffic, 4 the preset's own values."""
    return np.random.default_rng([seed, PRESET_NAMES.index(preset), part])
