# SPDX-License-Identifier: Apache-2.0
"""Small drives: a street with and without a car, as seen by a small sensor, and one in the layout of SemanticKITTI."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.geometry import se3
from dpm2_core.network.perception.range_image import RangeImageSettings

from ...helpers.scenes import boxes

MOTION = se3.exp([0, 0, 0.01, 0.6, 0.0, 0.0])
BUILDING, CAR, ROAD, UNLABELLED = 50, 10, 40, 0
SENSOR = RangeImageSettings(beams=((2.0, -14.0, 16),), first=0, rows=16, columns=64, scale=60.0)
"""Small enough for tests; the output of `write_pairs` matches it."""


def street_image(along: float, car: bool) -> np.ndarray:
    """(2, 16, 64) d and z, m: a road between walls with doors, seen `along` m down it; a car stays 8 m ahead."""
    elevation = np.radians(np.linspace(2.0, -14.0, 16))[:, None]
    azimuth = (np.arange(64) + 0.5) * (2 * np.pi / 64)
    wall = np.minimum(6.0 / np.abs(np.sin(azimuth)), 50.0)
    door = np.sin(2.1 * (along + wall * np.cos(azimuth))) > 0.6
    wall = wall * np.where(door, 1.15, 1.0)
    if car:
        wall = np.where(np.abs(np.remainder(azimuth + np.pi, 2 * np.pi) - np.pi) < 0.25, 8.0, wall)
    ground = np.where(elevation < -0.02, -1.73 / np.minimum(np.tan(elevation), -0.02), 50.0)
    d = np.minimum(wall[None], ground)
    return np.stack([d, d * np.tan(elevation)]).astype(np.float32)


def write_pairs(folder: Path, scans: int = 8) -> Path:
    """Two pairs of arrays in DSLR's layout, in units of 120 m."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(2):
        for name, car in (("s", False), ("d", True)):
            images = [street_image(0.5 * i + 17.0 * k, car) / 120.0 for i in range(scans)]
            np.save(folder / f"{name}{k}.npy", np.stack(images))
    return folder


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """Folder of two pairs of 8 scans."""
    return write_pairs(tmp_path / "pairs")


def labelled_drive(folder: Path, numbers: Iterable[int] = range(6), points: int = 1500, seed: int = 0) -> Path:
    """A sequence folder; returns it.

    Scans 0.6 m apart of a flat road and boxes: every 50th point is unlabelled; the last 100 are of a car, which the
    twin in static/ lacks. The upper half of a label is the object's number.
    """
    noise = np.random.default_rng(seed)
    world = boxes(noise, points).astype(np.float64)
    labels = np.where(np.arange(len(world)) < points // 2, ROAD, BUILDING).astype("<u4")
    labels[::50] = UNLABELLED
    car = noise.uniform([4, 2, -1.6], [7, 4, -0.2], (100, 3))
    for kind in ("velodyne", "labels", "static"):
        (folder / kind).mkdir(parents=True)
    T_world_scan = np.eye(4)
    for number in numbers:
        seen = se3.transform(se3.inverse(T_world_scan), world) + noise.normal(scale=0.01, size=world.shape)
        cloud = np.column_stack([np.vstack([seen, car]), np.full(len(world) + 100, 0.5)]).astype("<f4")
        cloud.tofile(folder / "velodyne" / f"{number:06d}.bin")
        np.append(labels, np.full(100, CAR + (7 << 16), "<u4")).tofile(folder / "labels" / f"{number:06d}.label")
        cloud[: len(world)].tofile(folder / "static" / f"{number:06d}.bin")
        T_world_scan = T_world_scan @ MOTION
    return folder


@pytest.fixture
def write_drive() -> Callable[..., Path]:
    """The function `labelled_drive`."""
    return labelled_drive
