# SPDX-License-Identifier: Apache-2.0
"""Packed drives and networks with another crop or image size: cropped again if that keeps less, otherwise an error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.packed import PackedDrive, Sample, open_packed, write_packed
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.pair_set import PairSet
from dpm2_core.learning.dataset import DataSettings, GroupDataset
from dpm2_core.learning.train_image import ImageDataset, ImageDataSettings
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.packed_frames import cropped_anew
from dpm2_core.network.pyramid import crop
from dpm2_core.network.settings import PointsSettings

from ...helpers.networks import tiny


def raw_cloud() -> np.ndarray:
    """(N, 3) points of the ground and of two walls, far denser than any crop."""
    noise = np.random.default_rng(0)
    flat = noise.uniform(-30, 30, (300_000, 2))
    wall = noise.uniform([-30, 0], [30, 5], (100_000, 2))
    ground = np.c_[flat, np.full(len(flat), -1.7)]
    ahead, beside = np.insert(wall, 0, 12.0, axis=1), np.insert(wall, 1, 7.0, axis=1)
    return noise.permutation(np.concatenate([ground, ahead, beside])).astype(np.float32)


@pytest.mark.parametrize("change", [{"voxel": 0.7}, {"near": 6.0}, {"far": 15.0}], ids=["voxel", "near", "far"])
def test_a_cloud_cropped_anew_is_like_one_that_was_never_packed(change: dict[str, float]) -> None:
    """The number of points is equal within 3 %, the bounds are equal, and no side of a voxel is preferred (2 cm:
    noise)."""
    cloud = raw_cloud()
    points = PointsSettings(**change)
    anew, direct = cropped_anew(crop(cloud, PointsSettings()), points), crop(cloud, points)
    assert len(anew) == pytest.approx(len(direct), rel=0.03)
    reach = np.linalg.norm(anew, axis=1)
    assert reach.min() >= points.near
    assert reach.max() <= points.far
    inside = np.abs(direct[:, :2]).max(1) < 20, np.abs(anew[:, :2]).max(1) < 20
    for axis in (0, 1):
        both = zip((direct, anew), inside, strict=True)
        cells = [np.mod(of[chosen, axis], points.voxel).mean() for of, chosen in both]
        assert cells[1] == pytest.approx(cells[0], abs=0.02)


def test_a_network_with_a_coarser_grid_learns_and_is_measured_on_it(packed: Path) -> None:
    """A packed drive is cropped again to a coarser grid. Previously, such a network was trained and evaluated on the
    grid of the packed drive, and used another grid only when it drove."""
    settings = DataSettings(packed={str(packed): 1.0}, groups=1, frames=2, workers=0)
    coarse = tiny(points={"voxel": 6.0})
    learned, measured = [], []
    for network in (tiny(), coarse):
        learned.append(int(GroupDataset(settings, network, settings.draw, 0)[0, 0].points.valid.min()))
        pairs = PairSet(packed, 2, network, False, farthest=5.1)
        straight = [number for (_, _, yaw), number in pairs.frames.items() if yaw == 0]
        xyz = pairs.encode(DeepPointMap2(network).eval())[straight[0]].xyz
        measured.append(len(np.unique(np.floor(xyz / 6.0), axis=0)) == len(xyz))
    assert learned[1] < learned[0] == 256
    assert measured == [False, True]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"points": {"voxel": 0.15}}, r"packed with points\.voxel 0\.3, but the network has 0\.15"),
        ({"points": {"near": 0.5}}, r"packed with points\.near 1, but the network has 0\.5"),
        ({"points": {"far": 100.0}}, r"packed with points\.far 60, but the network has 100"),
        ({"image": {"size": [64, 128]}}, r"packed with images of 32 x 64, but the network has 64 x 128"),
    ],
    ids=["voxel", "near", "far", "images"],
)
def test_a_network_that_wants_more_than_was_packed_is_an_error(packed: Path, change: dict, said: str) -> None:
    settings = DataSettings(packed={str(packed): 1.0}, images=True)
    with pytest.raises(UsageError, match=said):
        GroupDataset(settings, tiny(**change), settings.draw, 0)
    with pytest.raises(UsageError, match=said):
        PairSet(packed, 2, tiny(**change), True)
    if "image" in change:
        with pytest.raises(UsageError, match=said):
            ImageDataset(ImageDataSettings(packed={str(packed): 1.0}), tiny(**change), 0)
        blind = settings.model_copy(update={"images": False})
        assert GroupDataset(blind, tiny(**change), blind.draw, 0)[0, 0].views is None


def test_a_drive_says_how_it_was_cropped(samples: list[Sample], tmp_path: Path) -> None:
    """A drive that was packed for a coarser network lacks points for the usual one."""
    write_packed(tmp_path / "world", samples, {"crop": {"near": 1.0, "far": 60.0, "voxel": 0.6}})
    settings = DataSettings(packed={str(tmp_path): 1.0})
    with pytest.raises(UsageError, match=r"world: packed with points\.voxel 0\.6, but the network has 0\.3"):
        GroupDataset(settings, tiny(), settings.draw, 0)
    assert GroupDataset(settings, tiny(points={"voxel": 0.6}), settings.draw, 0)
    assert PackedDrive(tmp_path / "world").image_size == (32, 64)
    assert json.loads((tmp_path / "world" / "about.json").read_text())["crop"]["voxel"] == 0.6
    assert len(open_packed(tmp_path)) == 1
