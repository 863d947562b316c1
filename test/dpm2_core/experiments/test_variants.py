# SPDX-License-Identifier: Apache-2.0
"""Tables 3 and 4 and figure 7 on a small tree: drives packed, every variant fine-tuned from weights, tested in SLAM."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dpm2_core.errors import UsageError
from dpm2_core.experiments.request import Request
from dpm2_core.experiments.variant_part import TRAIN, training_of
from dpm2_core.experiments.variants import TABLE_3, fusion, reference_points
from dpm2_core.files import file_digest
from dpm2_core.fleet.part import DONE, Part, figures_of
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import preset
from dpm2_core.network.weights import save_weights

from ...helpers.command import dpm2
from ...helpers.layouts import kitti_odometry
from ...helpers.networks import tiny

QUICK = [
    word
    for setting in (
        "optimiser.steps=1", "optimiser.compile=false", "optimiser.bf16=false", "optimiser.warmup=0", "pairs=1",
        "sets=0", "data.groups=1", "data.frames=2", "data.workers=0", "slam.loops.enabled=false", "slam.threads=1",
    )
    for word in ("--set", setting)
]  # fmt: skip


@pytest.fixture(scope="module")
def kitti(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sequences 00 to learn from and 06 to be tested on, four scans each, with images."""
    return kitti_odometry(recording, tmp_path_factory.mktemp("kitti"), ("00", "06"), 4, images=True)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a tiny network."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(DeepPointMap2(tiny()), path, {"phase": "1"})
    return path


@pytest.mark.long
def test_fusion_then_its_attention_maps(kitti: Path, weights: Path, tmp_path: Path) -> None:
    """Every variant starts from the weights that fit it, the biased one from all; figure 7 needs no further
    training."""
    call = (kitti, "--out", tmp_path, "--weights", weights, *QUICK)
    done = dpm2("experiment", "fusion", *call, "--lengths", "1", "--frames", "0:3")
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "fusion.json").read_text())
    names = [row["name"] for row in record["tables"][0]["rows"] if row["origin"] == "this run"]
    assert names == ["biased attention", "PointPainting", "RoI pooling 3x3", "scale-dot attention", "without learnable",
                     "without spatial"]  # fmt: skip
    parts = record["parts"]
    assert parts["packed/00"]["frames"] == 4
    # Parts of the tiny network that the paper's lacks are left out; only the first layer of the reference points
    # differs.
    random = {name: parts[f"trained/{name.replace(' ', '_')}"]["random_at_start"] for name in names}
    assert set(random["biased attention"]) < set(random["PointPainting"])
    assert "encoder.points.patch.paint.weight" in random["PointPainting"]
    assert not any("decoder" in tensor for tensors in random.values() for tensor in tensors)
    assert [parts[f"variant_{name.replace(' ', '_')}/06"]["frames"] for name in names] == [3] * 6
    trained = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")}
    done = dpm2("experiment", "attention", *call)
    assert done.returncode == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in trained} == trained
    assert (tmp_path / "attention_06.png").stat().st_size > 20_000


def trainings(request: Request) -> list[Part]:
    """The parts that train."""
    return [part for stage in fusion.parts(request) for part in stage if part.work == TRAIN]


def test_what_is_learned_from_and_how_tells_trainings_apart(kitti: Path, weights: Path, tmp_path: Path) -> None:
    """With other sequences, or a YAML file with other content under the same name, every variant is trained again."""
    config = tmp_path / "training.yaml"
    config.write_text("pairs: 1\n")
    request = Request(kitti, tmp_path / "out", learn=("00",), weights=str(weights), config=config)
    for part in (one := trainings(request)):
        (done := tmp_path / "out" / part.name).mkdir(parents=True)
        record = {"arguments": dict(part.arguments), "files": {}, "figures": {}, "commit": "", "seconds": 0,
                  "peak_memory_mb": 0, "inputs": {str(path): file_digest(path) for path in part.inputs}}  # fmt: skip
        (done / DONE).write_text(json.dumps(record, default=str))
    assert all(figures_of(part, tmp_path / "out") is not None for part in one)
    both = trainings(replace(request, learn=("00", "06")))
    assert not any(figures_of(part, tmp_path / "out") for part in both)
    config.write_text("pairs: 2\n")
    assert not any(figures_of(part, tmp_path / "out") for part in trainings(request))


@pytest.mark.parametrize(("asked", "said"), [
    ("preset=paper", "preset paper: the weights --weights .*tiny.safetensors are of the preset tiny"),
    ("start=small", "start small: give the weights that all variants start from by --weights"),
    ("optimiser.stepps=3", "unknown key optimiser.stepps"),
    ("slam.neural.weights=small", "weights=small: each variant is run with its own weights; .* by --weights"),
    ("slam.neural={weights: small}", "weights=small: each variant"),
    ("slam.registration=geometric", "registration=geometric: the variants are run with the network alone"),
])  # fmt: skip
def test_settings_that_no_variant_is_trained_by_are_errors(
    asked: str, said: str, kitti: Path, weights: Path, tmp_path: Path
) -> None:
    """Settings that would have no effect are errors. Previously, another preset or start was ignored without a message,
    and the table was of `small`; misspelled settings were reported only after packing all drives; with other weights to
    drive, all rows were of these."""
    with pytest.raises(UsageError, match=said):
        fusion.parts(Request(kitti, tmp_path, weights=str(weights), overrides=(asked,)))
    fusion.parts(Request(kitti, tmp_path, weights=str(weights), overrides=("preset=tiny",)))  # the network's preset


def test_drives_to_learn_from_are_read_as_those_to_be_tested_on(kitti: Path, weights: Path, tmp_path: Path) -> None:
    """`--set input...` applies to all drives. Previously, it affected only the test drives: a data set that needs it
    was packed differently, or not at all."""
    asked = ("input.images=false", "optimiser.steps=1", "slam.threads=1")
    packs, _, driven = fusion.parts(Request(kitti, tmp_path, weights=str(weights), overrides=asked))
    assert [part.arguments["settings"] for part in packs] == [["input.sequence='00'", "input.images=false"]]
    assert "input.images=false" in driven[0].arguments["drive"]["settings"]


def test_table_4_has_as_many_reference_points_as_the_papers(kitti: Path, tmp_path: Path) -> None:
    """Both have 256, whose figures in the paper's Table 3 are those of biased attention; with the shipped weights,
    there were 320."""
    _, trained, _ = fusion.parts(Request(kitti, tmp_path, weights="small"))
    for part in trained:
        training = training_of(**part.arguments["training"], network=part.arguments["network"], packed=())
        assert preset(training.preset, training.network).fusion.points == 256


def test_a_row_of_table_3_has_as_many_reference_points_as_its_name_says(kitti: Path, tmp_path: Path) -> None:
    """Previously, two rows of 256 had the number of the weights: 320 of `small`, a quarter more than the rows to
    compare with."""
    _, trained, _ = reference_points.parts(Request(kitti, tmp_path, weights="small"))
    found = {}
    for part in trained:
        training = training_of(**part.arguments["training"], network=part.arguments["network"], packed=[])
        found[part.name] = preset(training.preset, training.network).fusion.points
    assert found == {part.name: int(part.name.rpartition("_")[2]) for part in trained}
    assert len(found) == len(TABLE_3)


@pytest.mark.long
def test_reference_points(kitti: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This covers every row; 4,096 points would take minutes here."""
    for name in ("uniform", "normal"):
        monkeypatch.setitem(TABLE_3, f"{name} 4096", {"fusion": {"reference": name, "points": 96}})
    call = ("experiment", "reference-points", kitti, "--out", tmp_path, "--weights", weights, *QUICK, "--lengths", "1")
    done = dpm2(*call, "--frames", "0:2")
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "reference-points.json").read_text())
    rows = record["tables"][0]["rows"]
    assert [row["name"] for row in rows if row["origin"] == "this run"] == [
        "FPS 128", "FPS 256", "FPS 512", "FPS and edges 256", "FPS, edges and image corners 256",
        "uniform 256", "uniform 4096", "normal 256", "normal 4096",
    ]  # fmt: skip
    paper = {row["name"]: row["cells"] for row in rows if row["origin"] == "the paper"}
    assert paper["FPS 256"]["06"] == {"t_err_percent": 0.47}
