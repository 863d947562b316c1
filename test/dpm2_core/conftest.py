# SPDX-License-Identifier: Apache-2.0
"""A small map; scans of one place; packed drives to train on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.geometry import se3, se3_torch
from dpm2_core.slam.store.map_store import Change, MapStore

from ..helpers.maps import change
from ..helpers.scenes import boxes, make_image


@pytest.fixture
def keyframes(noise: np.random.Generator) -> list[Keyframe]:
    """Twelve keyframes along a bend, with clouds, descriptors and odometry edges."""
    poses = se3.exp(np.arange(12)[:, None] * np.array([0, 0, 0.05, 5.0, 0.1, 0.0]))
    out = []
    for i, T in enumerate(poses):
        cloud = np.column_stack([noise.uniform(-40, 40, (300, 2)), noise.uniform(-2, 6, 300), noise.random(300)])
        d = Descriptors.of(noise.normal(size=(8, 3)).astype(np.float32), noise.normal(size=(8, 16)))
        covariance = np.diag(np.arange(1.0, 7.0)) * 1e-4
        edge = Registration(se3.inverse(poses[i - 1]) @ T, covariance, 0.9, 0.05, "test") if i else None
        out.append(Keyframe(i, 10**15 + i * 10**8 + 7, 3 * i, T, cloud.astype(np.float32), edge, "", d))
    return out


@pytest.fixture
def map_file(tmp_path: Path, keyframes: list[Keyframe]) -> Path:
    """A closed map file of those keyframes, with one accepted and one rejected loop."""
    path = tmp_path / "drive.dpm2map"
    with MapStore.create(path) as store:
        store.begin_session("slam: {}", "small 0123456789abcdef")
        for node, keyframe in enumerate(keyframes):
            store.write(change(node, keyframe))
            if (result := keyframe.edge) is not None:
                store.write(Change(edges=[Edge("odometry", node - 1, node, result)]))
        T = se3.inverse(keyframes[2].T_odom_kf) @ keyframes[11].T_odom_kf
        accepted = Edge("loop", 2, 11, Registration(T, np.eye(6) * 1e-4, method="test"))
        rejected = Edge("loop", 0, 11, Registration(np.eye(4), np.eye(6), 0.1, np.inf, "test", False, "too far"))
        store.write(Change(edges=[accepted, rejected]))
    return path


MOTION = se3.exp(np.array([0.002, -0.003, np.deg2rad(1.2), 0.8, 0.1, 0.02]))
"""From one scan to the next: 0.8 m, 1.2 deg."""


@pytest.fixture
def motion() -> Tensor:
    """(4, 4) T_scan_next."""
    return torch.from_numpy(MOTION)


@pytest.fixture
def scans(noise: np.random.Generator) -> list[Tensor]:
    """Four scans (600, 3) float64 of the same points from poses `motion` apart."""
    world = torch.from_numpy(boxes(noise, points=600)).double()
    out = [world]
    for _ in range(3):
        out.append(se3_torch.transform(torch.from_numpy(se3.inverse(MOTION)), out[-1]))
    return out


@pytest.fixture
def samples() -> list[Sample]:
    """Six scans of one place, 1 m apart, each with other points of the same surfaces."""
    out = []
    for i in range(6):
        cloud = boxes(np.random.default_rng(1), 6000)
        chosen = np.random.default_rng(i).permutation(len(cloud))[:3000]
        T = se3.exp([0, 0, 0.05 * i, 1.0 * i, 0.1 * i, 0])
        image = make_image(np.random.default_rng(i), (64, 32))
        out.append(Sample(se3.transform(se3.inverse(T), cloud[chosen]).astype(np.float32), T, (image,)))
    return out


@pytest.fixture
def packed(samples: list[Sample], tmp_path: Path) -> Path:
    """Parent folder of that drive, `world`."""
    write_packed(tmp_path / "data" / "world", samples, {"source": "boxes"})
    return tmp_path / "data"


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """torch's networks are small here: several threads take longer, and the order of sums then changes the last
    bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
