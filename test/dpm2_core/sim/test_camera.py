# SPDX-License-Identifier: Apache-2.0
"""Images: they agree with the LiDAR, are exactly repeatable, and show in degenerate places what the LiDAR cannot."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.geometry import se3
from dpm2_core.sim.camera import calibration, render
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.materials import Label, Material
from dpm2_core.sim.settings import CameraConfig, LidarConfig
from dpm2_core.sim.shading import Textures, VisiblePoints
from dpm2_core.sim.world import World

SMALL = CameraConfig(width=320, height=96, focal=190, noise=0)


def _picture(world: World, T_world_lidar: np.ndarray, config: CameraConfig = SMALL, seed: int = 0) -> np.ndarray:
    T_world_cam = T_world_lidar @ calibration(config).T_lidar_cam
    return render(world, config, T_world_cam, 1.0, np.random.default_rng(seed))


@pytest.mark.slow
def test_a_image_is_exposed_varied_and_repeatable(city: World) -> None:
    noisy = SMALL.model_copy(update={"noise": 2.0})
    one, same, other = (_picture(city, city.pose_at(40.0), noisy, seed) for seed in (1, 1, 2))
    assert one.shape == (96, 320, 3)
    assert one.dtype == np.uint8
    assert 70 < one.mean() < 180
    assert one.std() > 25
    np.testing.assert_array_equal(one, same)
    assert 1.0 < np.abs(one.astype(int) - other).mean() < 4.0  # two samples of a noise of 2


@pytest.mark.slow
def test_lidar_points_project_onto_the_pixels_that_show_them(city: World) -> None:
    """The ray through a point's pixel ends on an object of the point's class."""
    config = CameraConfig()
    camera = calibration(config)
    T_world_lidar = city.pose_at(40.0)
    scan = Lidar(LidarConfig(noise=0.0)).scan(city, T_world_lidar, 0.0, np.random.default_rng(0))
    T_cam_lidar = se3.inverse(camera.T_lidar_cam)
    points = se3.transform(T_cam_lidar, scan.points[~scan.moving, :3].astype(float))
    label = scan.label[~scan.moving]
    ahead = points[:, 2] > 2
    points, label = points[ahead], label[ahead]
    pixel = points @ camera.K.T
    pixel = pixel[:, :2] / pixel[:, 2:]
    inside = (pixel > 1).all(1) & (pixel < np.array(camera.size) - 2).all(1)
    points, label, pixel = points[inside], label[inside], pixel[inside].round()
    rays = np.column_stack([pixel, np.ones(len(pixel))]) @ np.linalg.inv(camera.K).T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    T_world_cam = T_world_lidar @ camera.T_lidar_cam
    origins = np.tile(T_world_cam[:3, 3].astype(np.float32), (len(rays), 1))
    hits = city.scene.cast(origins, np.ascontiguousarray((rays @ T_world_cam[:3, :3].T).astype(np.float32)))
    smooth = np.isin(label, [Label.ROAD, Label.SIDEWALK, Label.BUILDING])
    same = (city.static.label[hits.face] == label)[smooth]
    assert smooth.sum() > 3000
    assert same.mean() > 0.95  # the rest is due to half a pixel, and to the camera's other viewpoint at edges


def test_white_paint_is_seen_where_the_road_has_it(highway: World) -> None:
    """The edge line of the lane is brighter than the asphalt next to it: image and lane coordinates agree."""
    config = SMALL.model_copy(update={"width": 640, "height": 192, "focal": 380.0})
    camera = calibration(config)
    T_world_cam = highway.pose_at(150.0) @ camera.T_lidar_cam
    image = render(highway, config, T_world_cam, 0.0, np.random.default_rng(0)).mean(-1)

    def brightness(lateral: float) -> float:
        street = highway.road.streets[0]
        xy = street.at(street.s[(street.s > 156) & (street.s < 166)], lateral)[0]
        xyz = np.column_stack([xy, highway.terrain.height_at(xy)])
        seen = se3.transform(se3.inverse(T_world_cam), xyz) @ camera.K.T
        u, v = (seen[:, :2] / seen[:, 2:]).round().astype(int).T
        inside = (u >= 0) & (u < config.width) & (v >= 0) & (v < config.height)
        assert inside.sum() > 5
        return float(image[v[inside], u[inside]].mean())

    line = 2.6 - highway.terrain.preset.half_width
    assert brightness(line) > brightness(line - 0.6) + 15
    assert brightness(line) > brightness(line + 0.6) + 15


def test_in_a_tunnel_only_the_image_tells_the_motion(tunnel: World) -> None:
    before, after = (_picture(tunnel, tunnel.pose_at(s)).astype(float) for s in (120.0, 120.8))
    assert np.abs(before - after).mean() > 4.0


@pytest.mark.parametrize("material", [Material.TILE, Material.ASPHALT, Material.PLASTER])
def test_textures_do_not_repeat(material: Material, highway: World) -> None:
    """No shift of 1 to 150 m along a wall or road gives a similar strip."""
    along = np.arange(0, 400, 0.1, np.float32)
    n = len(along)
    street = highway.road.streets[0]
    xy = street.at(np.minimum(along, 200), 0.9)[0] if material == Material.ASPHALT else np.zeros((n, 2))
    strip = VisiblePoints(
        position=np.column_stack([xy, np.zeros(n)]).astype(np.float32),
        normal=np.tile(np.float32([1, 0, 0]), (n, 1)),
        view=np.tile(np.float32([-1, 0, 0]), (n, 1)),
        uv=np.column_stack([along, np.full(n, 0.7)]).astype(np.float32),
        texture=np.zeros(n, np.uint16),
        material=np.full(n, material, np.uint8),
        color=np.full((n, 3), 0.3, np.float32),
        footprint=np.full(n, 0.1, np.float32),
    )
    shade = Textures(3).albedo(strip, highway.terrain).sum(1)
    shade = (shade - shade.mean()) / shade.std()
    correlation = [float((shade[:2000] * shade[k : 2000 + k]).mean()) for k in range(10, 1500)]
    assert np.abs(correlation).max() < 0.6


def test_images_without_sky_and_without_anything_else(city: World) -> None:
    """A view of the ground, and one of the sky."""
    axes = np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, -1]])
    x, y, z = city.pose_at(40.0)[:3, 3]
    down = render(city, SMALL, se3.make(axes, (x, y, z + 1)), 0.0, np.random.default_rng(0))
    up = render(city, SMALL, se3.make(axes * [[1], [-1], [-1]], (x, y, z + 60)), 0.0, np.random.default_rng(0))
    assert down.std() > 3
    assert up.mean() > 80


def test_drops_on_the_lens_blur_their_share_of_the_image_and_stay_where_they_are(city: World) -> None:
    dry = CameraConfig(width=320, height=100, focal=180, noise=0.0)
    wet = dry.model_copy(update={"wet": 0.2, "lens": 3})
    changed = []
    for s in (20.0, 60.0):
        T = city.pose_at(s) @ calibration(dry).T_lidar_cam
        clear, blurred = (render(city, config, T, 0.0, np.random.default_rng(0)) for config in (dry, wet))
        changed.append((clear != blurred).any(-1))
    assert all(0.15 < part.mean() < 0.45 for part in changed)
    assert (changed[0] & changed[1]).mean() > 0.6 * min(part.mean() for part in changed)


def test_hours_later_the_shadows_lie_elsewhere_and_the_scene_is_the_same(city: World) -> None:
    config = CameraConfig(width=320, height=100, focal=180, noise=0.0)
    city = replace(city, light=copy.copy(city.light))
    city.light.overcast = 0.0
    T = city.pose_at(40.0) @ calibration(config).T_lidar_cam
    now, same, later = (
        render(city, config, T, 0.0, np.random.default_rng(0), hours).astype(float) for hours in (0.0, 0.0, 3.0)
    )
    np.testing.assert_array_equal(now, same)
    assert 2 < np.abs(now - later).mean() < 60
    sun = city.light.later(3.0).sun
    assert np.linalg.norm(sun) == pytest.approx(1, abs=1e-5)
    assert np.degrees(np.arcsin(sun[2])) < np.degrees(np.arcsin(city.light.sun[2])) or sun[2] < 0.15
