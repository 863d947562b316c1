# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks.second_camera`: benefit of a second camera for the descriptors, where the geometry constrains
the motion fully, or not along the road.

Pairs of scans 1 to 5 m apart in suburbs, highways and tunnels that were not used in training, registered with their
descriptors without any prior: from the LiDAR alone, and with images of cameras like the one that the network was
trained with.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.pairs import summarized
from dpm2_core.commands.options import run_command
from dpm2_core.console import Console, tracked
from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Array, Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.learning.generate import training_camera
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pretrained import load_network
from dpm2_core.sim.camera import calibration, render
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable

WORLDS: dict[PresetName, Sequence[int]] = {
    "suburb": (910_100, 910_101), "highway": (920_100, 920_101), "tunnel": (930_100, 930_101),
}  # fmt: skip
"""Seeds: training begins at 1,000, validation at 900,000."""
FRAMES, STEP = 16, 1.25
"""Number of frames in each world, and m between two frames."""
APART = (1, 2, 3, 4)
"""Steps between the two frames of a pair."""
YAWS = {"front": 0.0, "rear": 180.0, "left": 90.0, "right": -90.0}
"""Viewing direction of each camera, deg to the left."""
WAYS = ((), ("front",), ("rear",), ("front", "rear"), ("left", "right"))
"""The cameras whose images are used in the descriptors."""


def bench() -> int:
    """Errors of pairs with no image, one and two."""
    s = SlamSettings().neural
    network = load_network(s.weights, 1)
    figures = ("pairs", "median m", "median deg", "success")
    table = FigureTable("Pairs 1 to 5 m apart by descriptors alone", names=["world", "cameras"], figures=figures)
    for kind, seeds in WORLDS.items():
        rows = np.concatenate([errors(network, kind, seed) for seed in seeds], axis=1)
        for cameras, variant_errors in zip(WAYS, rows, strict=True):
            found = summarized(variant_errors)
            values = (f"{found['pairs']}", *(f"{found[key]:.2f}" for key in ("median_m", "median_deg", "success")))
            table.add_row(kind, " and ".join(cameras) or "none", *values)
        table.add_section()
    Console().print(table)
    return 0


def errors(network: DeepPointMap2, kind: PresetName, seed: int) -> Array:
    """(variants, pairs, 2) m and deg, for one world."""
    world = build_world("straight", kind, seed, 300.0)
    poses, described = list[Array](), list[list[Descriptors]]()
    for T, frame in tracked(_frames(world, network), f"{kind} {seed}", FRAMES):
        images = {image.camera.name: image for image in frame.images}
        poses.append(T)
        described.append(
            [network.describe(replace(frame, images=tuple(images[n] for n in variant))) for variant in WAYS]
        )
    pairs = [(a, a + k) for k in APART for a in range(FRAMES - k)]
    out = np.zeros((len(WAYS), len(pairs), 2))
    for variant in range(len(WAYS)):
        for number, (a, b) in enumerate(pairs):
            found = network.register(described[b][variant], described[a][variant]).T_target_source
            out[variant, number] = se3.apart(se3.inverse(poses[a]) @ poses[b], found)
    return out


def _frames(world: World, network: DeepPointMap2) -> Iterator[tuple[Array, Frame]]:
    """T_world_lidar and a frame with the images of all cameras, every `STEP` m."""
    lidar, rng = Lidar(LidarConfig()), np.random.default_rng(world.seed)
    config = training_camera(network.settings)
    start = float(world.road.distance(1.0))
    times = np.arange(1.0, 20.0, 0.005)
    stamps = np.interp(start + STEP * np.arange(FRAMES), [float(world.road.distance(t)) for t in times], times)
    for number, time in enumerate(stamps.tolist()):
        T = world.drive_pose(time)
        images = []
        for name, yaw in YAWS.items():
            camera = calibration(config)
            T_lidar_cam = se3.exp([0, 0, np.radians(yaw), 0, 0, 0]) @ camera.T_lidar_cam
            pixels = render(world, config, T @ T_lidar_cam, time, rng)
            images.append(Image(pixels, replace(camera, T_lidar_cam=T_lidar_cam, name=name)))
        yield T, Frame(round(time * 1e9), lidar.scan(world, T, time, rng).points, images=tuple(images), index=number)


if __name__ == "__main__":
    sys.exit(run_command(bench))
