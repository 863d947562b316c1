# SPDX-License-Identifier: Apache-2.0
"""A LiDAR that is mounted at an angle is registered like a level one, also from the opposite heading."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dpm2_core.data.open import open_source
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pretrained import load_network
from dpm2_core.network.pyramid import build_pyramid, collate, crop

from ...helpers.networks import tiny
from ...helpers.scenes import boxes

TURNED = se3.exp([0, 0, np.pi, 0, 0, 0])
MOUNTS = {
    "30 deg of pitch": (se3.exp([0, np.radians(30), 0, 0, 0, 0]),) * 2,
    "-25 deg of roll": (se3.exp([np.radians(-25), 0, 0, 0, 0, 0]),) * 2,
    "each its own": (se3.exp([0.4, 0.3, 0, 0, 0, 0]), se3.exp([-0.2, 0.55, 0, 0, 0, 0])),
    "one of them": (np.eye(4), se3.exp([0, 0.6, 0, 0, 0, 0])),
}


def mounted(frame: Frame, T: Array) -> Frame:
    return Frame(frame.stamp, se3.transform(T, frame.points).astype(np.float32))


def pair_errors(root: Path, number: int, T_first: Array, T_second: Array) -> list[tuple[float, float]]:
    """Errors in m and degrees of scans `number` apart, with the shipped network."""
    source, network = open_source(root), load_network("small", 1)
    frames, poses = list(source.frames(0, 25)), source.poses
    assert poses is not None
    errors = []
    for a in (0, 8, 16):
        target, scan = (network.describe(mounted(frames[i], T)) for i, T in ((a, T_first), (a + number, T_second)))
        T = T_first @ se3.inverse(poses[a]) @ poses[a + number] @ se3.inverse(T_second)
        errors.append(se3.apart(T, network.register(scan, target).T_target_source))
    return errors


@pytest.mark.weights
@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_a_tilted_sensor_meets_itself_from_the_other_heading(recording: Path, mount: str) -> None:
    first, second = MOUNTS[mount]
    for meters, degrees in pair_errors(recording, 4, first, second @ TURNED):
        assert meters < 0.25  # level it is 0.03 to 0.1 m
        assert degrees < 1.0


@pytest.mark.weights
@pytest.mark.parametrize("sequence", ["00", "04"])
def test_so_it_does_in_real_scans(kitti_root: Path, sequence: str) -> None:
    first, second = MOUNTS["30 deg of pitch"]
    for meters, degrees in pair_errors(kitti_root / "sequences" / sequence, 3, first, second @ TURNED):
        assert meters < 0.3
        assert degrees < 1.0


@pytest.mark.weights
@pytest.mark.slow
def test_the_uncertainty_of_a_tilted_pair_is_that_of_the_level_one_in_its_own_axes(recording: Path) -> None:
    network, frames = load_network("small", 1), list(open_source(recording).frames(0, 5))
    T = MOUNTS["30 deg of pitch"][0]
    results = []
    for mount in (np.eye(4), T):
        target, scan = (network.describe(mounted(frames[i], mount)) for i in (0, 4))
        results.append(network.register(scan, target))
    level, tilted = results
    A = se3.adjoint(se3.inverse(T))
    back = A @ tilted.covariance @ A.T
    # Other reference points, so not equal: within a factor of 1.5, while directions differ by more than that.
    np.testing.assert_allclose(np.sqrt(np.diag(back) / np.diag(level.covariance)), 1, atol=0.5)
    assert np.abs(np.linalg.slogdet(back)[1] - np.linalg.slogdet(level.covariance)[1]) < 6 * 2 * np.log(1.5)


def model() -> DeepPointMap2:
    torch.manual_seed(0)
    return DeepPointMap2(tiny()).eval().requires_grad_(False)


def street(noise: np.random.Generator) -> np.ndarray:
    """(N, 3) points: level ground and boxes on it."""
    points = boxes(noise, 8000)
    return points[points[:, 2] >= -1.7]


def frame(points: np.ndarray) -> Frame:
    return Frame(0, np.column_stack([points, np.zeros(len(points))]).astype(np.float32))


@pytest.mark.parametrize("what", ["level", "leans by 3 degrees", "no ground"])
def test_where_there_is_nothing_to_level_the_descriptors_are_those_of_the_scan_as_it_is(
    noise: np.random.Generator, what: str
) -> None:
    network = model()
    lean = se3.exp([0.05, 0, 0, 0, 0, 0])[:3, :3]
    level, leaves = street(noise), noise.normal(size=(3000, 3)) * 9
    points = {"level": level, "leans by 3 degrees": level @ lean.T, "no ground": leaves}[what]
    found = network.describe(frame(points))
    pyramid = build_pyramid(crop(frame(points).points, network.settings.points), network.settings)
    plain = network.encoder.encode_batch(collate([pyramid]), None)[0]
    assert found.up is None
    np.testing.assert_array_equal(found.xyz, plain.xyz)
    np.testing.assert_array_equal(found.features, plain.features)


def test_what_hangs_or_lies_by_its_mounting_is_described_as_if_it_stood(noise: np.random.Generator) -> None:
    """If no ground is visible, the mounting alone defines the level; if ground is visible, both do."""
    network, standing = model(), street(noise)
    R = np.diag([1.0, -1, -1])  # exact, so that the rotated scan is the same
    plain, found = network.describe(frame(standing)), network.describe(replace(frame(standing @ R), up=(0.0, 0.0, -1)))
    np.testing.assert_array_equal(found.features, plain.features)
    np.testing.assert_array_equal(found.xyz @ R, plain.xyz)
    assert found.up is not None
    np.testing.assert_array_equal(found.up, [0, 0, -1])
    leaves, up = noise.normal(size=(3000, 3)) * 9, (0.6, 0.0, 0.8)
    by_mount = network.describe(replace(frame(leaves), up=up)).up
    np.testing.assert_array_equal(by_mount, np.array(up, np.float32))
    lean = se3.exp([0.3, 0, 0, 0, 0, 0])[:3, :3]  # inclination of the ground, such as a ramp
    on_a_ramp = network.describe(replace(frame(standing @ (lean @ R).T), up=(0.0, 0.0, -1))).up
    np.testing.assert_allclose(on_a_ramp, lean @ R[2], atol=0.02)


def test_descriptors_of_a_tilted_scan_lie_in_its_own_frame(noise: np.random.Generator) -> None:
    lean = se3.exp([0.2, 0.4, 0, 0, 0, 0])[:3, :3]
    points = (street(noise) @ lean.T).astype(np.float32)
    found = model().describe(frame(points))
    assert found.up is not None
    np.testing.assert_allclose(found.up, lean[:, 2], atol=0.02)
    nearest = np.linalg.norm(points[None] - found.xyz[:, None], axis=2).min(1)
    assert np.quantile(nearest, 0.4) < 1e-4  # half are points of the scan; those of its vertical edges are means
