# SPDX-License-Identifier: Apache-2.0
"""`dpm2 train dslr|ae_lidar` and `dpm2 eval-task` on pairs in DSLR's layout: figures, image, and invalid requests."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ...helpers.command import dpm2, refused, succeeded

SENSOR = "network.image={beams: [[2, -14, 16]], first: 0, rows: 16, columns: 64, scale: 120}"
SMALL = [SENSOR, "network.channels=4", "network.latent=8", "window=3", "every=1", "batch=1", "slam_loss.points=200"]


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """One pair of arrays of 6 scans: range images of a room, with an object in the middle of the dynamic ones."""
    rng = np.random.default_rng(0)
    d = np.broadcast_to(12 + 3 * np.sin(np.arange(64) / 5), (6, 16, 64)) + rng.normal(scale=0.02, size=(6, 16, 64))
    z = d * np.tan(np.radians(np.linspace(2, -14, 16)))[None, :, None]
    static = np.stack([d, z], 1).astype(np.float32) / 120
    dynamic = static.copy()
    dynamic[:, :, :, 20:30] *= 0.5
    folder = tmp_path / "pairs"
    folder.mkdir()
    np.save(folder / "s0.npy", static)
    np.save(folder / "d0.npy", dynamic)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "stages", "figures"),
    [
        ("dslr", ["autoencoder_epochs=1", "discriminator_epochs=1"], {"chamfer_m", "chamfer", "moved_m"}),
        ("ae_lidar", ["network.variational=true"], {"chamfer_m", "chamfer", "d_error_m"}),
    ],
)
def test_train_and_measure(pairs: Path, tmp_path: Path, name: str, stages: list[str], figures: set[str]) -> None:
    """The SLAM loss is on in the last of three epochs; one task rejects the other's weights; the SLAM needs poses."""
    out = tmp_path / "out"
    settings = [word for setting in [*SMALL, *stages, "epochs=3"] for word in ("--set", setting)]
    slam = ["--set", "slam.gamma=0.5", "--set", "slam.every=3"]
    assert dpm2("train", name, pairs, "--out", out, *settings, *slam).returncode == 0
    log = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in log if "slam_loss" in row] == [4, 5]

    weights, image = out / "weights.safetensors", tmp_path / "scan.png"
    done = succeeded("eval-task", name, weights, pairs, "--json", "-", "--picture", image, "--frame", "2")
    printed = json.loads(done.stdout)
    assert printed["scans"] == 6
    assert figures <= printed.keys()
    assert image.stat().st_size > 1000

    assert "no poses0.txt next to the pairs" in refused("eval-task", name, weights, pairs, "--slam")
    other = "ae_lidar" if name == "dslr" else "dslr"
    assert f"weights of {name}, not of {other}" in refused("eval-task", other, weights, pairs)
