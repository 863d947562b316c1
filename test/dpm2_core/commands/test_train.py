# SPDX-License-Identifier: Apache-2.0
"""Notes of `dpm2 train` about scans that are used for both training and evaluation."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.geometry import se3

from ...helpers.command import dpm2, succeeded
from ...helpers.networks import TINY
from ..tasks.conftest import labelled_drive, write_pairs

QUICK = ("epochs=1", "optimiser.warmup=0", "window=2", "every=1", "batch=1")
GROUND = ("network.cells=32", "network.cell=2", "network.channels=4")
RANGE = (
    "network.image={beams: [[2, -14, 16]], first: 0, rows: 16, columns: 64, scale: 60}",
    "network.channels=4",
    "network.latent=8",
)


def sets(*settings: str) -> list[str]:
    """`--set` before each setting."""
    return [word for setting in settings for word in ("--set", setting)]


def notes(done: str) -> list[str]:
    """The notes about scans that are used for training."""
    return [line for line in done.splitlines() if line.startswith("note: ")]


@pytest.mark.slow
def test_sequences_that_a_task_is_measured_on_and_learns_from_are_named(tmp_path: Path) -> None:
    """With `--val-sequences 02`, and `--sequences` forgotten, the task also learns from 02, which is reported.
    Previously, it was reported only if all the evaluation data was all the training data."""
    data = tmp_path / "data"
    for name in ("00", "01", "02"):
        labelled_drive(data / "sequences" / name, range(2), points=300, seed=int(name))
    one = data / "sequences" / "02"

    def said(number: int, *more: object) -> list[str]:
        out = tmp_path / f"out{number}"
        done = succeeded("train", "gndnet", data, "--out", out, *sets(*QUICK, *GROUND), *more)
        return notes(done.stderr)

    assert said(0, "--val", data, "--val-sequences", "02") == [f"note: --val {data}: the task trains on these scans"]
    both = ("--sequences", "00,02", "--val-sequences", "01,02")
    assert said(1, "--val", data, *both) == [f"note: --val {data}: the task trains on these scans: 02"]
    assert said(2, "--val", one) == [f"note: --val {one}: the task trains on these scans"]  # by another name
    assert said(3, "--val", data, "--sequences", "00,01", "--val-sequences", "02") == []
    copy = shutil.copytree(one, tmp_path / "copy")
    assert said(4, "--sequences", "02", "--val", copy) == [f"note: --val {copy}: the task trains on these scans"]


@pytest.mark.slow
def test_pairs_that_are_measured_on_and_learned_from_are_named(tmp_path: Path) -> None:
    data = write_pairs(tmp_path / "pairs", scans=2)
    call = ("train", "ae_lidar", data, *sets(*QUICK, *RANGE), "--val", data)
    done = dpm2(*call, "--out", tmp_path / "a", "--sequences", "1")
    assert notes(done.stderr) == [f"note: --val {data}: the task trains on these scans: pairs/d1"]
    done = dpm2(*call, "--out", tmp_path / "b", "--sequences", "1", "--val-sequences", "0")
    assert (done.returncode, notes(done.stderr)) == (0, [])


@pytest.mark.slow
def test_packed_drives_of_a_validation_that_are_learned_from_are_named(
    packed: Path, samples: list[Sample], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drives of weight zero are not named; a part that was packed again is, since figures on the same scans show
    nothing. Of the processes of torchrun, only the first reports it."""
    elsewhere, again = tmp_path / "elsewhere", tmp_path / "again"
    north = se3.exp([0, 0, 0, 0, 100, 0])
    write_packed(elsewhere / "world", [s._replace(pose=north @ s.pose) for s in samples], {"source": "boxes"})
    write_packed(again / "world", [samples[i] for i in (0, 1, 5)], {"source": "boxes"})
    tree = {
        "network": TINY, "validation_pairs": 2, "pairs": 1, "data": {"groups": 1, "frames": 2, "workers": 0},
        "optimiser": {"steps": 1, "compile": False, "warmup": 0},
    }  # fmt: skip
    (tmp_path / "asked.yaml").write_text(json.dumps(tree))
    cases = [(1, packed, 0, 1), (0, packed, 0, 0), (1, elsewhere, 0, 0), (1, again, 0, 1), (1, again, 1, 0)]
    for number, (weight, validation, rank, said) in enumerate(cases):
        monkeypatch.setenv("RANK", str(rank))
        drives = json.dumps({str(packed): weight, **({} if weight else {str(elsewhere): 1})})
        call = ("train", "phase1", "--config", tmp_path / "asked.yaml", "--out", tmp_path / f"out{number}")
        done = succeeded(*call, *sets(f"data.packed={drives}", f"validation={validation}"))
        assert notes(done.stderr) == [f"note: validation {validation}: the network trains on these scans"] * said


@pytest.mark.weights
@pytest.mark.slow
def test_weights_to_start_from_have_a_name_as_everywhere(tmp_path: Path) -> None:
    """Trainings accept the names of weights that come with dpm2, as other commands do; previously, they required the
    path."""
    done = dpm2("train", "phase1", "--out", tmp_path / "a", "--set", "start=small")
    assert "data.packed: no packed drives" in done.stderr  # the weights were found
    (content,) = [
        key for key in json.loads((tmp_path / "a" / "begun.json").read_text()) if key.startswith("content of")
    ]
    assert content.endswith("/small.safetensors")
    done = dpm2("train", "phase2", "--out", tmp_path / "b", "--set", "start=nowhere")
    assert (done.returncode, "weights nowhere: no such file; weights shipped with dpm2: " in done.stderr) == (2, True)
    assert not (tmp_path / "b").exists()
