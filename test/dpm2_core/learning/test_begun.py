# SPDX-License-Identifier: Apache-2.0
"""A training continues from its checkpoint if it is started with the same settings and file contents."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError
from dpm2_core.learning.begun import begin_or_resume, begin_training
from dpm2_core.learning.checkpoint import CHECKPOINT, LOG, WEIGHTS
from dpm2_core.learning.train_overlap import OverlapTrainingSettings
from dpm2_core.learning.trainer import OptimizerSettings

from ...helpers.command import dpm2


class Training(Settings):
    """Settings of a training."""

    network: dict[str, dict[str, int]] = Field({"points": {"stem": 16}})
    workers: int = 1
    optimiser: OptimizerSettings = OptimizerSettings()


def left(folder: Path) -> None:
    """Write the files that a training leaves."""
    for name in (CHECKPOINT, LOG, WEIGHTS):
        (folder / name).write_text("of the training before")


@pytest.fixture
def read(tmp_path: Path) -> Path:
    """A file that the training begins with."""
    path = tmp_path / "start.safetensors"
    path.write_text("weights")
    return path


def test_the_same_training_goes_on(tmp_path: Path, read: Path) -> None:
    """The same training is resumed, also with settings that do not change what is learned."""
    folder = tmp_path / "training"
    begin_training(folder, Training(), [read], {"SRC": "a"})
    left(folder)
    begin_training(folder, Training(workers=3), [read], {"SRC": "a"})
    assert (folder / CHECKPOINT).exists()
    assert (folder / WEIGHTS).exists()


@pytest.mark.parametrize("changed", ["settings", "data", "content", "missing"])
def test_another_one_begins_anew(tmp_path: Path, read: Path, changed: str) -> None:
    """Another training begins anew, also if only the content of a file of the same name has changed."""
    folder = tmp_path / "training"
    begin_training(folder, Training(), [read], {"SRC": "a"})
    left(folder)
    if changed == "content":
        read.write_text("others!")
    elif changed == "missing":
        read.unlink()
    settings = Training(optimiser=OptimizerSettings(steps=20)) if changed == "settings" else Training()
    begin_training(folder, settings, [read], {"SRC": "b" if changed == "data" else "a"})
    assert not (folder / CHECKPOINT).exists()
    assert not (folder / WEIGHTS).exists()


def test_it_goes_on_from_the_checkpoint_of_another_one(tmp_path: Path) -> None:
    """A training starts from the checkpoint of another one, and is resumed until that one has a new checkpoint."""
    start, folder = tmp_path / "start", tmp_path / "training"
    start.mkdir()
    left(start)
    for _ in range(2):
        begin_training(folder, Training(), start=start)
        assert (folder / CHECKPOINT).read_text() == "of the training before"
    (folder / WEIGHTS).write_text("its own")
    (start / CHECKPOINT).write_text("of another one")
    begin_training(folder, Training(), start=start)
    assert (folder / CHECKPOINT).read_text() == "of another one"
    assert not (folder / WEIGHTS).exists()


def test_a_folder_that_cannot_be_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="file/training: no folder can be made there: Not a directory"):
        begin_training(tmp_path / "file" / "training", Training())


@pytest.mark.parametrize(
    ("tree", "data", "difference"),
    [
        ({"optimiser": {"seed": 9}}, {"SRC": "a"}, "optimiser.seed 0, not 9"),
        ({"optimiser": {"steps": 4000}}, {"SRC": "a"}, "optimiser.steps 3000, not 4000"),
        ({"network": {"points": {"stem": 8}}}, {"SRC": "a"}, "network.points.stem 16, not 8"),
        ({}, {"SRC": "b"}, "SRC a, not b"),
    ],
)
def test_a_training_is_not_resumed_with_something_else(
    tmp_path: Path, tree: dict[str, object], data: dict[str, object], difference: str
) -> None:
    """Another seed, rate or data is an error. Previously, the training continued without a message, and its weights
    recorded the last request."""
    begin_or_resume(tmp_path, False, Training(), data={"SRC": "a"})
    left(tmp_path)
    begin_or_resume(tmp_path, True, Training(), data={"SRC": "a"})
    with pytest.raises(UsageError, match=f"began with {difference}; --resume needs the same settings"):
        begin_or_resume(tmp_path, True, Training.model_validate(tree), data=data)
    begin_or_resume(tmp_path, True, Training(), data={"SRC": "a"})


def test_a_training_of_another_version_is_resumed_where_its_settings_are_the_same(tmp_path: Path) -> None:
    """A setting that no longer exists, or a different value of one that was added, is an error; previously, the
    training continued."""
    begin_or_resume(tmp_path, False, Training())
    left(tmp_path)
    asked = tmp_path / "begun.json"
    now = json.loads(asked.read_text())
    asked.write_text(json.dumps({**now, "optimiser.lookahead": 3}))
    with pytest.raises(UsageError, match=r"began with optimiser\.lookahead 3, a setting of another version of dpm2"):
        begin_or_resume(tmp_path, True, Training())
    del now["optimiser.seed"]
    asked.write_text(json.dumps(now))
    with pytest.raises(UsageError, match=r"began with optimiser\.seed 0, not 9"):
        begin_or_resume(tmp_path, True, Training(optimiser=OptimizerSettings(seed=9)))
    begin_or_resume(tmp_path, True, Training())


def test_a_training_that_needs_a_setting_is_resumed_with_the_same(tmp_path: Path) -> None:
    """The overlap training needs `start`, and can be resumed with it; previously, --resume ended with a traceback."""
    asked = OverlapTrainingSettings(start="phase1")
    begin_or_resume(tmp_path, False, asked)
    left(tmp_path)
    begin_or_resume(tmp_path, True, asked)
    with pytest.raises(UsageError, match="began with start phase1, not phase2"):
        begin_or_resume(tmp_path, True, OverlapTrainingSettings(start="phase2"))


def test_weights_of_another_content_and_other_processes_are_something_else(
    tmp_path: Path, read: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights of the same name with other content, or another number of processes under torchrun, are an error.
    Settings that do not change what is learned may change."""
    out = tmp_path / "out"
    begin_or_resume(out, False, Training(), [read])
    left(out)
    free = Training(workers=3, optimiser=OptimizerSettings(save_every=7, validate_every=9))
    begin_or_resume(out, True, free, [read])
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(UsageError, match="processes 1, not 2"):
        begin_or_resume(out, True, Training(), [read])
    read.write_text("others!")
    with pytest.raises(UsageError, match=rf"content of {read} \w+, not \w+"):
        begin_or_resume(out, True, Training(), [read])


@pytest.mark.parametrize(
    "command",
    [
        ("train", "gndnet", "DATA"),
        ("train", "movers", "DATA"),
        ("train", "ablation"),
        ("finetune", "DATA"),
        ("experiment", "kitti", "DATA", "--out", "OUT"),
    ],
    ids=" ".join,
)
def test_processes_that_would_all_do_the_same_are_refused(
    tmp_path: Path, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands that do not divide their work reject torchrun. Previously, two processes trained a task on the same
    scans, to the weights of one, and fine-tunings packed the same folders."""
    monkeypatch.setenv("WORLD_SIZE", "2")
    places = {"DATA": str(tmp_path), "OUT": str(tmp_path / "out")}
    done = dpm2(*(places.get(word, word) for word in command))
    assert done.returncode == 2
    assert "start it without torchrun, which works only with dpm2 train image, phase1 and phase2" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_that_does_not_say_how_it_began_is_gone_on_with(tmp_path: Path) -> None:
    """A checkpoint of an earlier version is resumed; a new training does not replace it."""
    left(tmp_path)
    begin_or_resume(tmp_path, True, Training())
    with pytest.raises(UsageError, match="contains a training; continue it with --resume"):
        begin_or_resume(tmp_path, False, Training())
    (tmp_path / CHECKPOINT).unlink()
    with pytest.raises(UsageError, match=r"no checkpoint\.pt to resume"):
        begin_or_resume(tmp_path, True, Training())
