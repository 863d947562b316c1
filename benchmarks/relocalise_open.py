# SPDX-License-Identifier: Apache-2.0
"""Relocalization where the geometry looks alike everywhere: one scan on a highway and in a tunnel of one kilometer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.progress import Progress

from benchmarks.relocalise_visits import evaluate_visit, keyframe_cloud, preprocessed, relocalizer_in, success_rates
from dpm2_core.data.thumbnail import PLACE_WIDTH, thumbnail
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Array, Frame, Image
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.sim.camera import calibration, render
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import CameraConfig, PresetName
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.loops.pictures import KnownMap
from dpm2_core.slam.settings import SlamSettings

WORLDS: dict[PresetName, int] = {"highway": 951, "tunnel": 952}
"""Environments, and their seeds."""
LENGTH = 1000.0
"""Length of each road, m, without added curves."""
_CAMERA = CameraConfig(width=620, height=188, focal=360.0)
_MAX_HEADING = 0.1
"""Largest difference in heading from the map, rad: a camera that faces back sees another image."""


@dataclass(frozen=True)
class _Observation:
    """A pose on the road, with a frame from there."""

    T_map_lidar: Array
    frame: Frame


def open_roads(
    settings: SlamSettings, network: DeepPointMap2, progress: Progress, spacing: float = 5.0, visits: int = 40
) -> dict[str, Any]:
    """Random visits to each road, with other traffic, searched in its map; without images, and with images of both.

    Args:
        spacing: distance of the map's keyframes along the road, m.
    """
    out: dict[str, Any] = {}
    for preset, seed in WORLDS.items():
        world, rng = build_world("random", preset, seed, LENGTH), np.random.default_rng(seed)
        distances = np.arange(spacing, world.road.drive.length - spacing, spacing)
        times = np.interp(distances, world.road.travelled, world.road.times).tolist()
        road = [(world.pose_at(s), time) for s, time in zip(distances, times, strict=True)]
        visit_poses = [world.sample_pose(rng, heading=_MAX_HEADING) for _ in range(visits)]
        task = progress.add_task(preset, total=len(road) + len(visit_poses))
        observations = [
            _Observation(T, _frame(world, T, time, rng)) for T, time in progress.track(road + visit_poses, task_id=task)
        ]
        known, visited = observations[: len(road)], observations[len(road) :]
        out[preset] = {"keyframes": len(road)} | {
            label: _relocalised(settings, network, known, visited, images)
            for label, images in (("without images", False), ("with images", True))
        }
    return out


def _frame(world: World, T: Array, time: float, rng: np.random.Generator) -> Frame:
    view = calibration(_CAMERA)
    pixels = render(world, _CAMERA, T @ view.T_lidar_cam, time, rng)
    return Frame(0, Lidar().scan(world, T, time, rng).points, images=(Image(pixels, view),))


def _relocalised(
    settings: SlamSettings,
    network: DeepPointMap2,
    known: Sequence[_Observation],
    visited: Sequence[_Observation],
    images: bool,
) -> dict[str, Any]:
    def keyframe(frame: Frame) -> Keyframe:
        points = preprocessed(frame, settings)
        described = network.describe(Frame(0, points, images=frame.images if images else ()))
        small_image = thumbnail(frame.images[0], PLACE_WIDTH) if images else None
        return Keyframe(
            0, 0, 0, np.eye(4), keyframe_cloud(points, settings), descriptors=described, thumbnail=small_image
        )

    keyframes = [keyframe(observation.frame) for observation in known]
    poses = np.stack([observation.T_map_lidar for observation in known])
    in_map = KnownMap(keyframes, lambda n: keyframes[n].cloud, poses, lambda n: keyframes[n].thumbnail)
    find = relocalizer_in(settings, network, in_map).find
    return success_rates(
        [evaluate_visit(find, keyframe(observation.frame), observation.T_map_lidar) for observation in visited]
    )
