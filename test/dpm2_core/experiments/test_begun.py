# SPDX-License-Identifier: Apache-2.0
"""A training goes on from its checkpoint where the same is asked for, of files that hold the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from dpm2_core.errors import UsageError
from dpm2_core.experiments.begun import begin_training

WEIGHTS = "weights.safetensors"


def left(folder: Path) -> None:
    """What a training leaves."""
    for name in ("checkpoint.pt", "log.jsonl", WEIGHTS):
        (folder / name).write_text("of the training before")


@pytest.fixture
def read(tmp_path: Path) -> Path:
    """A file that the training begins with."""
    path = tmp_path / "start.safetensors"
    path.write_text("weights")
    return path


def test_the_same_training_goes_on(tmp_path: Path, read: Path) -> None:
    folder = tmp_path / "training"
    assert not begin_training(folder, "steps: 10\n", WEIGHTS, [read])
    left(folder)
    assert begin_training(folder, "steps: 10\n", WEIGHTS, [read])
    assert (folder / WEIGHTS).exists()


@pytest.mark.parametrize("changed", ["text", "content", "missing"])
def test_another_one_begins_anew(tmp_path: Path, read: Path, changed: str) -> None:
    """Also where only the content of a file of the same name is another."""
    folder = tmp_path / "training"
    begin_training(folder, "steps: 10\n", WEIGHTS, [read])
    left(folder)
    if changed == "content":
        read.write_text("others!")
    elif changed == "missing":
        read.unlink()
    assert not begin_training(folder, "steps: 20\n" if changed == "text" else "steps: 10\n", WEIGHTS, [read])
    assert not (folder / WEIGHTS).exists()


def test_it_goes_on_from_the_checkpoint_of_another_one(tmp_path: Path) -> None:
    """Until that has another checkpoint."""
    start, folder = tmp_path / "start", tmp_path / "training"
    start.mkdir()
    left(start)
    for _ in range(2):
        assert begin_training(folder, "steps: 10\n", WEIGHTS, start=start)
        assert (folder / "checkpoint.pt").read_text() == "of the training before"
    (folder / WEIGHTS).write_text("its own")
    (start / "checkpoint.pt").write_text("of another one")
    assert begin_training(folder, "steps: 10\n", WEIGHTS, start=start)
    assert (folder / "checkpoint.pt").read_text() == "of another one"
    assert not (folder / WEIGHTS).exists()


def test_a_folder_that_cannot_be_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="file/training: no folder can be made there: Not a directory"):
        begin_training(tmp_path / "file" / "training", "", WEIGHTS)
