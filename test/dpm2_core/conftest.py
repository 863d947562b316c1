# SPDX-License-Identifier: Apache-2.0
"""A street of boxes, a camera, networks small enough; a small map."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dpm2_core.config import settings_from
from dpm2_core.descriptors import Descriptors
from dpm2_core.frame import Camera, Image, Keyframe, Registration
from dpm2_core.geometry import se3, se3_torch
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.map_store import Change, MapStore
from dpm2_core.slam.store.rows import Edge

TINY = {
    "preset": "tiny",
    "channels": 32,
    "points": {
        "stages": [
            {"points": 256, "radius": 2, "neighbours": 8, "channels": 16},
            {"points": 64, "radius": 6, "neighbours": 8, "channels": 32, "residual_radii": [12.0]},
        ]
    },
    "image": {"size": [32, 64], "depths": [1, 1, 1], "channels": [8, 16, 16], "pyramid": 16, "strides": [8, 16]},
    "fusion": {"points": 48, "layers": 1, "levels": [1], "alpha_image": [0.3, 1.0, 2.5, 6.0]},
    "decoder": {"width": 32, "layers": 1},
}


def tiny(**changes: dict[str, object]) -> NetworkSettings:
    """The tiny network with sections changed."""
    tree = {key: {**value, **changes.get(key, {})} if isinstance(value, dict) else value for key, value in TINY.items()}
    return settings_from(NetworkSettings, tree)


def street(noise: np.random.Generator, points: int = 4000) -> np.ndarray:
    """(points, 3) float32 on the ground and on the faces of boxes, 1.7 m below to 8 m above the sensor."""
    ground = np.column_stack([noise.uniform(-40, 40, (points // 2, 2)), np.full(points // 2, -1.7)])
    parts = [ground]
    boxes = 25
    for _ in range(boxes):
        center = np.append(noise.uniform(-35, 35, 2), -1.7)
        half = noise.uniform([1, 1, 1], [5, 5, 8])
        side = noise.uniform(-1, 1, (points // 2 // boxes, 3))
        axis = noise.integers(0, 2, len(side))
        side[np.arange(len(side)), axis] = np.sign(side[np.arange(len(side)), axis])
        parts.append(center + side * half)
    return np.concatenate(parts).astype(np.float32)


def make_image(noise: np.random.Generator, size: tuple[int, int] = (128, 64)) -> Image:
    """A forward-looking camera with a random image, (width, height)."""
    K = np.array([[60.0, 0, size[0] / 2 - 0.5], [0, 60.0, size[1] / 2 - 0.5], [0, 0, 1]])
    T_lidar_cam = se3.make([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.3, 0.05, -0.1])
    pixels = noise.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    return Image(pixels, Camera(K, T_lidar_cam, size))


@pytest.fixture(name="tiny")
def _tiny() -> Callable[..., NetworkSettings]:
    """Settings of the tiny network, with sections changed."""
    return tiny


@pytest.fixture(name="street")
def _street() -> Callable[..., np.ndarray]:
    """street(noise, points=4000): a cloud."""
    return street


@pytest.fixture(name="make_image")
def _make_image() -> Callable[..., Image]:
    """image(noise, size=(128, 64)): an image with its camera."""
    return make_image


@pytest.fixture
def noise() -> np.random.Generator:
    """Seeded."""
    return np.random.default_rng(7)


@pytest.fixture
def model() -> DeepPointMap2:
    """A tiny network with seeded random weights."""
    torch.manual_seed(0)
    return DeepPointMap2(tiny()).eval()


@pytest.fixture
def drive(noise: np.random.Generator) -> list[Keyframe]:
    """Twelve keyframes along a bend, with clouds, descriptors and odometry edges."""
    poses = se3.exp(np.arange(12)[:, None] * np.array([0, 0, 0.05, 5.0, 0.1, 0.0]))
    out = []
    for i, T in enumerate(poses):
        cloud = np.column_stack([noise.uniform(-40, 40, (300, 2)), noise.uniform(-2, 6, 300), noise.random(300)])
        d = Descriptors(noise.normal(size=(8, 3)).astype(np.float32), noise.normal(size=(8, 16)).astype(np.float16))
        covariance = np.diag(np.arange(1.0, 7.0)) * 1e-4
        edge = Registration(se3.inverse(poses[i - 1]) @ T, covariance, 0.9, 0.05, "test") if i else None
        out.append(Keyframe(i, 10**15 + i * 10**8 + 7, 3 * i, T, cloud.astype(np.float32), edge, "", d))
    return out


@pytest.fixture
def map_file(tmp_path: Path, drive: list[Keyframe]) -> Path:
    """A closed map file of that drive, with a loop that was accepted and one that was rejected."""
    path = tmp_path / "drive.dpm2map"
    with MapStore.create(path) as store:
        store.begin_session("slam: {}", "small 0123456789abcdef")
        for node, keyframe in enumerate(drive):
            change = Change([(node, keyframe, pack_cloud(keyframe.cloud), None)], poses={node: keyframe.T_odom_kf})
            if (result := keyframe.edge) is not None:
                info = (result.T_target_source, result.covariance)
                change.edges.append(Edge("odometry", node - 1, node, *info, True, 0.9, 0.05, "test"))
            store.write(change)
        T = se3.inverse(drive[2].T_odom_kf) @ drive[11].T_odom_kf
        rejected = Edge("loop", 0, 11, np.eye(4), np.eye(6), False, 0.1, np.inf, "test", "too far")
        store.write(Change(edges=[Edge("loop", 2, 11, T, np.eye(6) * 1e-4, method="test"), rejected]))
    return path


MOTION = se3.exp(np.array([0.002, -0.003, np.deg2rad(1.2), 0.8, 0.1, 0.02]))
"""From a scan to the next: 0.8 m, 1.2 deg."""


@pytest.fixture
def motion() -> Tensor:
    """(4, 4) T_scan_next."""
    return torch.from_numpy(MOTION)


@pytest.fixture
def scans(street: Callable[..., np.ndarray], noise: np.random.Generator) -> list[Tensor]:
    """Four scans (600, 3) float64 of the same points from poses `motion` apart."""
    world = torch.from_numpy(street(noise, points=600)).double()
    out = [world]
    for _ in range(3):
        out.append(se3_torch.transform(torch.from_numpy(se3.inverse(MOTION)), out[-1]))
    return out
