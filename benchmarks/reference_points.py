# SPDX-License-Identifier: Apache-2.0
"""Which reference points of a frame are close to one of the next frame, given the true motion; nothing is learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.figures import bars_png
from benchmarks.harness import Options, drives, truth_of
from dpm2_core.frame import Array, Frame, Image, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.sampling import evenly
from dpm2_core.learning.generate import training_camera
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pyramid import build_pyramid, crop
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.sim.camera import calibration, render
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import build_world

WITHIN = (0.2, 0.4)
"""Largest distances of two reference points that count as the same point, m."""
APART = (1, 3, 8)
"""Distance between the two frames, in frames."""
WITH_IMAGES = "salient, with images"
_METHODS = {"farthest points": "fps", "salient": "salient", WITH_IMAGES: "salient"}
_SIMULATED: tuple[PresetName, ...] = ("city", "suburb", "rural", "highway", "tunnel", "indoor", "car_park")
_FRAMES, _SEED = 30, 950_000


def repeated(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Shares for every drive and for one simulated drive of each kind, with a realistic sensor; and a figure of them.

    Simulated drives are left out with `--unseen`.
    """
    found: dict[str, Any] = {}
    with drives(options) as sources:
        for name, source in sources.items():
            found[name] = shares(list(source.frames()), truth_of(source), network.settings, options.pairs)
    for kind in _SIMULATED if options.unseen is None else ():
        found[f"simulated {kind}"] = shares(*_simulated(kind, network.settings), network.settings, options.pairs)
    groups = {
        drive: {name: row["1 apart"][f"{WITHIN[0]} m"] for name, row in rows.items()} for drive, rows in found.items()
    }
    title = f"Reference points within {WITHIN[0]} m of one of the next frame"
    bars_png(options.out / "neural_reference.png", groups, title)
    return {"shares": found}


def _simulated(kind: PresetName, network: NetworkSettings) -> tuple[list[Frame], Array]:
    config, camera = real_sensor(LidarConfig()), training_camera(network)
    if kind == "indoor":
        config = config.model_copy(update={"height": 1.0, "car_body": False, "min_range": 0.4})
    world, lidar = build_world("random", kind, _SEED, 200.0), Lidar(config)
    view, frames, poses = calibration(camera), [], []
    for i in range(_FRAMES):
        time, noise = 0.1 * i if kind != "indoor" else 0.5 * i, np.random.default_rng([_SEED, i])  # at 1.2 m/s
        poses.append(lidar.pose(world, time))
        points = lidar.drive_scan(world, poses[-1], time, noise).points
        pixels = render(world, camera, poses[-1] @ view.T_lidar_cam, time, noise)
        frames.append(Frame(i, points, images=(Image(pixels, view),)))
    return frames, np.stack(poses)


def shares(frames: Sequence[Frame], poses: Array, network: NetworkSettings, most: int) -> dict[str, Any]:
    """Shares by method of selection and frames apart: the mean over at most `most` pairs."""
    cropped = [crop(frame.points, network.points) for frame in frames]
    out: dict[str, Any] = {}
    for name, reference in _METHODS.items():
        if name == WITH_IMAGES and not (network.fusion.corners and any(frame.images for frame in frames)):
            continue
        settings = network.model_copy(update={"fusion": network.fusion.model_copy(update={"reference": reference})})
        images = [frame.images if name == WITH_IMAGES else () for frame in frames]
        references = [_references(*scan, settings) for scan in zip(cropped, images, strict=True)]
        out[name] = {}
        for apart in APART:
            starts = evenly(len(frames) - apart, most).tolist()
            pairs = [(a, a + apart) for a in starts if np.isfinite(poses[[a, a + apart]]).all()]
            distance = [
                cKDTree(references[b]).query(se3.transform(se3.inverse(poses[b]) @ poses[a], references[a]))[0]
                for a, b in pairs
            ]
            fractions = {f"{limit} m": float(np.mean([(row < limit).mean() for row in distance])) for limit in WITHIN}
            out[name][f"{apart} apart"] = {"pairs": len(pairs), **fractions}
    return out


def _references(cloud: Points, images: Sequence[Image], network: NetworkSettings) -> Array:
    """(n, 3) m: the first points of the pyramid."""
    pyramid = build_pyramid(cloud, network, images)
    return pyramid.xyz[: min(network.fusion.points, pyramid.count)].astype(float)
