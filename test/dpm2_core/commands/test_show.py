# SPDX-License-Identifier: Apache-2.0
"""`dpm2 show` draws what the network matched, and rejects what it cannot draw in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.weights import save_weights

from ...helpers.command import refused, succeeded
from ...helpers.networks import tiny
from ...helpers.scenes import boxes


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans of a street, 1 m apart, and weights of a tiny untrained network next to them."""
    folder = tmp_path_factory.mktemp("show")
    (folder / "velodyne").mkdir()
    points = np.c_[boxes(np.random.default_rng(0)), np.full(4000, 0.5)].astype(np.float32)
    for number in (0, 1):
        (points - np.array([number, 0, 0, 0], np.float32)).tofile(folder / "velodyne" / f"{number:06d}.bin")
    torch.manual_seed(0)
    save_weights(DeepPointMap2(tiny()), folder / "tiny.safetensors", {})
    return folder


@pytest.mark.slow
def test_draws_an_image(sequence: Path, tmp_path: Path) -> None:
    weights = str(sequence / "tiny.safetensors")
    succeeded("show", sequence, "0", "1", "--out", str(tmp_path / "m.png"), "--weights", weights)
    assert (tmp_path / "m.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_draws_the_image_with_attention(sequence: Path, tmp_path: Path) -> None:
    """With weights that use a camera and a drive with images, the drawing has a third part below."""
    folder = tmp_path / "drive"
    shutil.copytree(sequence, folder)
    (folder / "calib.txt").write_text("P2: 60 0 63.5 0 0 60 31.5 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3\n")
    (folder / "image_2").mkdir()
    for number in (0, 1):
        cv2.imwrite(str(folder / "image_2" / f"{number:06d}.png"), np.full((64, 128, 3), 90, np.uint8))
    torch.manual_seed(0)
    save_weights(DeepPointMap2(tiny()), folder / "camera.safetensors", {"images": "true"})
    sizes = []
    for name in ("tiny", "camera"):
        out, weights = tmp_path / f"{name}.png", str(folder / f"{name}.safetensors")
        succeeded("show", folder, "0", "1", "--out", str(out), "--weights", weights)
        sizes.append(cv2.imread(str(out)).shape)
    assert sizes[1][0] > 1.5 * sizes[0][0]
    assert sizes[1][1] == sizes[0][1]


@pytest.mark.slow
def test_several_weights_are_drawn_below_each_other_of_a_sensor_that_fails(sequence: Path, tmp_path: Path) -> None:
    torch.manual_seed(1)
    save_weights(DeepPointMap2(tiny()), tmp_path / "other.safetensors", {})
    weights = ["--weights", sequence / "tiny.safetensors", "--weights", tmp_path / "other.safetensors"]
    shapes, pictures = [], []
    for name, arguments in (
        ("one", weights[:2]), ("two", weights), ("half", [*weights[:2], "--corrupt", "obstruction=1,seed=1"])
    ):  # fmt: skip
        done = succeeded("show", sequence, "0", "1", "--out", tmp_path / f"{name}.png", *arguments)
        pictures.append(cv2.imread(str(tmp_path / f"{name}.png")))
        shapes.append(pictures[-1].shape)
    assert shapes[1] == (2 * shapes[0][0], shapes[0][1], 3)
    assert np.abs(pictures[2].astype(int) - pictures[0]).mean() > 0.1  # half of the view is covered
    assert "obstruction=1,seed=1" in done.stderr


def test_one_of_several_sequences_is_shown(sequence: Path, tmp_path: Path) -> None:
    """The sequence can be chosen with --set. Previously, the error named a setting that the command did not accept."""
    for name in ("00", "01"):
        shutil.copytree(sequence / "velodyne", tmp_path / "sequences" / name / "velodyne")
    call = ("show", tmp_path, "0", "1", "--out", tmp_path / "m.png", "--weights", sequence / "tiny.safetensors")
    assert "choose one with input.sequence: 00, 01" in refused(*call)
    done = succeeded(*call, "--set", "input.sequence=01")
    assert "01, frame 1 to frame 0" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["0", "1", "--set", "slam.map.voxel=1"], "allowed here: input"),
        (["0", "1", "--corrupt", "nothing=1"], "nothing"),
        (["0"], "Missing argument"),
        (["0", "7"], "2 frames"),
        (["0", "1", "--weights", "/nowhere"], "/nowhere"),
    ],
)
def test_errors_of_use(sequence: Path, arguments: list[str], words: str) -> None:
    assert words in refused("show", sequence, *arguments)
