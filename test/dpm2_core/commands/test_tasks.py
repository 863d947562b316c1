# SPDX-License-Identifier: Apache-2.0
"""`dpm2 train gndnet` and `dpm2 eval-task`: from files to figures, and errors of use in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.network.pretrained import PRETRAINED_DIR

from ...helpers.command import Done, dpm2, refused, succeeded

SMALL = ["network.cells=32", "network.cell=2", "network.channels=4", "window=3", "every=1", "slam_loss.points=300"]
SLAM = ["--set", "slam.gamma=0.5"]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Four labelled scans of a field with a wall on either side, 0.5 m apart."""
    noise = np.random.default_rng(0)
    ground = np.column_stack([noise.uniform(-25, 25, (600, 2)), np.full(600, -1.7)])
    walls = np.column_stack([noise.uniform(-25, 25, 300), noise.choice([-8.0, 8.0], 300), noise.uniform(-1.7, 2, 300)])
    labels = np.repeat(np.array([40, 50], "<u4"), [600, 300])
    folder = tmp_path / "sequences" / "00"
    for kind in ("velodyne", "labels"):
        (folder / kind).mkdir(parents=True)
    for i in range(4):
        points = np.vstack([ground, walls]) - [0.5 * i, 0, 0] + noise.normal(scale=0.01, size=(900, 3))
        np.column_stack([points, np.full(900, 0.5)]).astype("<f4").tofile(folder / "velodyne" / f"{i:06d}.bin")
        labels.tofile(folder / "labels" / f"{i:06d}.label")
    return tmp_path


def train(recording: Path, out: Path, *more: object) -> Done:
    """A training of three epochs of one step."""
    settings = [word for setting in [*SMALL, "epochs=3", "optimiser.warmup=1"] for word in ("--set", setting)]
    return dpm2("train", "gndnet", recording, "--out", out, *settings, *more)


@pytest.mark.slow
def test_train_resume_and_measure(recording: Path, tmp_path: Path) -> None:
    """The SLAM loss is on in the third epoch; a second training does not overwrite; figures, table and image."""
    out, third = tmp_path / "out", ("--set", "slam.every=3")
    first = train(recording, out, *SLAM, *third, "--val", recording)
    assert first.returncode == 0
    assert f"--val {recording}: the task trains on these scans" in first.stderr
    log = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in log if "slam_loss" in row] == [2]
    assert "miou" in log[-1]
    again = train(recording, out)
    assert again.returncode == 2
    assert "continue it with --resume" in again.stderr
    assert train(recording, out, "--resume", *SLAM, *third).returncode == 0  # nothing is left to do
    other = train(recording, out, "--resume", *SLAM)
    assert (other.returncode, other.stderr.count("\n")) == (2, 1)
    assert "began with slam.every 3, not " in other.stderr
    assert len((out / "log.jsonl").read_text().splitlines()) == len(log)

    weights, image = out / "weights.safetensors", tmp_path / "ground.png"
    done = succeeded("eval-task", "gndnet", weights, recording, "--json", "-", "--picture", image)
    printed = json.loads(done.stdout)
    assert printed["scans"] == 4
    assert {"mse", "miou", "precision", "recall"} <= printed.keys()
    assert image.stat().st_size > 1000
    assert "precision" in dpm2("eval-task", "gndnet", weights, recording).stdout

    label = recording / "sequences" / "00" / "labels" / "000003.label"
    np.where(np.fromfile(label, "<u4") == 40, 48, 50).astype("<u4").tofile(label)  # the same points, labeled again
    replaced = train(recording, out, "--resume", *SLAM, *third)
    assert (replaced.returncode, replaced.stderr.count("\n")) == (2, 1)
    assert "began with content of SRC " in replaced.stderr


def test_errors_of_use(recording: Path, tmp_path: Path) -> None:
    """Exit code 2 and one line that names the error."""
    out = tmp_path / "out"
    assert "nowhere: no such folder" in refused("train", "gndnet", tmp_path / "nowhere", "--out", out)
    unknown = ("--set", "network.cellz=3")
    assert "unknown key network.cellz" in refused("train", "gndnet", recording, "--out", out, *unknown)
    assert "no checkpoint.pt to resume" in refused("train", "gndnet", recording, "--out", out, "--resume")
    assert "no sequence has the 9 scans" in refused("train", "gndnet", recording, "--out", out)  # 5 of every second
    assert "slam.gamma=-1" in refused("train", "gndnet", recording, "--out", out, "--set", "slam.gamma=-1")
    assert not (out / "checkpoint.pt").exists()
    assert "no such weights" in refused("eval-task", "gndnet", tmp_path / "none.safetensors", recording)
    assert "nonsense: no such task" in refused("eval-task", "nonsense", tmp_path / "none.safetensors", recording)
    label = recording / "sequences" / "00" / "labels" / "000001.label"
    label.write_bytes(label.read_bytes()[:-4])
    assert "000001.label: 899 labels for 900 points" in refused("train", "gndnet", recording, "--out", out)
    label.unlink()
    assert "000001.label: No such file" in refused("train", "gndnet", recording, "--out", out)


@pytest.mark.parametrize(
    ("road", "wall", "message"),
    [(9, 13, "00, scan 0: a label has class 9, which SemanticKITTI does not have"), (1, 0, "00: no point of any scan")],
)
def test_labels_that_are_numbered_in_another_way_are_named(
    recording: Path, tmp_path: Path, road: int, wall: int, message: str
) -> None:
    """The numbers that networks are trained on, and ground or not. Previously `movers` took the first for cars and
    bicycles, both trainings ended with weights that had learned nothing, and all figures were nan."""
    for path in (recording / "sequences" / "00" / "labels").iterdir():
        np.where(np.fromfile(path, "<u4") == 40, road, wall).astype("<u4").tofile(path)
    shipped = {"gndnet": PRETRAINED_DIR / "gndnet.safetensors", "movers": PRETRAINED_DIR / "movers.safetensors"}
    settings = ("--set", "window=2", "--set", "every=1", "--set", "epochs=1", "--set", "batch=1")
    for name, weights in shipped.items():
        assert message in refused("eval-task", name, weights, recording)
        if road == 1:
            assert message in refused("train", name, recording, "--out", tmp_path / name, *settings)


@pytest.mark.slow
def test_data_of_the_tasks(tmp_path: Path) -> None:
    """`dpm2 train tasks-data` fills train/ and val/, and accepts the settings of the sensor."""
    settings = ["train=1", "val=1", "train_frames=2", "val_frames=2", "lidar.columns=48", "lidar.beams=16"]
    words = [word for setting in settings for word in ("--set", setting)]
    assert dpm2("train", "tasks-data", tmp_path / "data", *words, "--workers", "1").returncode == 0
    for which in ("train", "val"):
        folder = tmp_path / "data" / which / "00" / "sequences" / "00"
        for kind in ("velodyne", "labels", "static"):
            assert len(list((folder / kind).iterdir())) == 2
