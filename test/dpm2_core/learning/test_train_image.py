# SPDX-License-Identifier: Apache-2.0
"""Training of the image branch alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.errors import UsageError
from dpm2_core.frame import R_AHEAD, Camera
from dpm2_core.geometry import se3
from dpm2_core.learning.checkpoint import read_log
from dpm2_core.learning.train_image import ImageDataset, ImageDataSettings, ImageTrainingSettings, shown, train_image
from dpm2_core.learning.trainer import OptimizerSettings
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.weights import save_weights

from ...helpers.networks import tiny
from ...helpers.training import stopped


@pytest.fixture
def network() -> NetworkSettings:
    """The tiny network."""
    return tiny()


@pytest.fixture
def settings(packed: Path, network: NetworkSettings, tmp_path: Path) -> ImageTrainingSettings:
    """Four steps on the packed drive, from weights in `start.safetensors`."""
    torch.manual_seed(0)
    start = tmp_path / "start.safetensors"
    save_weights(DeepPointMap2(network), start, {})
    return ImageTrainingSettings(
        network=network.model_dump(),
        data=ImageDataSettings(packed={str(packed): 1.0}, groups=2, radius=3),
        points=32,
        optimiser=OptimizerSettings(steps=4, compile=False, bf16=False, save_every=2, warmup=1),
        start=str(start),
    )


@pytest.mark.slow
def test_it_changes_the_image_branch_alone(
    settings: ImageTrainingSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LiDAR, fusion and decoder stay identical bit for bit, and resuming gives the weights of one run."""
    whole = load_file(train_image(settings, tmp_path / "whole"))
    before = load_file(Path(settings.start))
    changed = {name for name in before if not torch.equal(before[name], whole[name])}
    assert changed
    assert all(name.startswith(("encoder.image.", "encoder.fusion.pixel.")) for name in changed)
    stopped(lambda: train_image(settings, tmp_path / "halves"), monkeypatch)
    halves = load_file(train_image(settings, tmp_path / "halves"))
    assert all(torch.equal(whole[name], halves[name]) for name in whole)
    rows = read_log(tmp_path / "whole")
    assert all(np.isfinite(row["loss"]) and 0 <= row["right"] <= 1 for row in rows)


def _spread(points: torch.Tensor) -> torch.Tensor:
    return (points[:, :, None] - points[:, None]).norm(dim=-1)


@pytest.mark.slow
def test_points_of_a_pair_are_the_same_in_the_world(settings: ImageTrainingSettings, network: NetworkSettings) -> None:
    """The second half of each pair is the first half seen from the other frame: an isometry, in front of the camera."""
    batch = next(ImageDataset(settings.data, network, 0).pairs(settings.points))
    first, second = batch.points[::2], batch.points[1::2]
    torch.testing.assert_close(_spread(first), _spread(second), atol=1e-3, rtol=0)
    assert batch.views.pixels.shape[:2] == (4, 1)


def test_shown_is_what_projects_into_the_image() -> None:
    """A point ahead and inside the image is, points behind or outside are not. The camera looks along the LiDAR's x."""
    T_lidar_cam = se3.make(R_AHEAD, np.zeros(3))
    camera = Camera(np.array([[50, 0, 50], [0, 50, 25], [0, 0, 1.0]]), T_lidar_cam, (100, 50))
    points = np.array([[10, 0, 0], [-10, 0, 0], [10, 9, 0], [10, 11, 0], [10, 0, 6]], np.float32)
    assert shown(points, camera).tolist() == [True, False, True, False, False]


def test_what_cannot_be_trained_is_rejected(
    settings: ImageTrainingSettings, samples: list[Sample], tmp_path: Path
) -> None:
    """A network without image features of its own, a drive without images, and too few points."""
    with pytest.raises(UsageError, match="no features of single image pixels"):
        train_image(settings.model_copy(update={"network": {"fusion": {"pixel": False}}, "start": ""}), tmp_path / "a")
    with pytest.raises(UsageError, match=r"hardly any image shows 99999 points"):
        train_image(settings.model_copy(update={"points": 99_999}), tmp_path / "b")
    write_packed(tmp_path / "blind" / "world", [s._replace(images=()) for s in samples], {})
    blind = settings.data.model_copy(update={"packed": {str(tmp_path / "blind"): 1.0}})
    with pytest.raises(UsageError, match=r"world: has no images"):
        train_image(settings.model_copy(update={"data": blind}), tmp_path / "c")
