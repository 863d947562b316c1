# SPDX-License-Identifier: Apache-2.0
"""The fine-tuning benchmark: which trainings it starts, how it evaluates them, and what it reuses from a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import finetune
from benchmarks.harness import Options, earlier, write_report
from dpm2_core.learning.finetune_settings import FinetuneSettings

BEFORE = {"near_m": 0.1, "far_m": 0.2, "all_m": 0.15, "all_deg": 0.1, "success": 0.9, "pairs": 10}


def _run(factor: float) -> dict:
    after = {key: value * factor for key, value in BEFORE.items()}
    ratio = {name: dict.fromkeys(("near_m", "far_m", "all_m", "all_deg"), factor) for name in finetune.UNSEEN}
    return {"after": dict.fromkeys(finetune.UNSEEN, after), "ratio": ratio, "steps": 1, "cpu_seconds": 1.0}


def test_each_loss_alone_is_trained_once_and_both_for_every_seed() -> None:
    assert finetune.trainings(Options(repetitions=3)) == [
        ("trajectory", 0), ("pairs", 0), ("both", 0), ("poses", 0), ("trajectory", 1), ("trajectory", 2)
    ]  # fmt: skip
    assert finetune.trainings(Options(repetitions=3, only="pairs")) == [("pairs", 0)]


def test_results_are_found_again_by_a_run_of_the_same_settings_and_weights(tmp_path: Path) -> None:
    settings, options = FinetuneSettings(), Options(out=tmp_path)
    results = {"before": dict.fromkeys(finetune.UNSEEN, BEFORE), "runs": {"both": {"0": _run(0.6), "1": _run(0.8)}}}
    same = {"settings": settings.model_dump(mode="json"), "weights_sha256": "digest"}
    report = finetune.report(same, **results)
    found = report.results["ratios"]["both"]["new"]["all_m"]
    assert found == {"mean": pytest.approx(0.7), "spread": pytest.approx(0.1), "seeds": 2}
    path = tmp_path / "finetune.json"
    write_report(path, report, options)
    assert {key: earlier(path, key, **same) for key in results} == results
    other = {**same, "settings": FinetuneSettings(radius=3.0).model_dump(mode="json")}
    assert earlier(path, "runs", **other) == {}
    assert earlier(path, "runs", **{**same, "weights_sha256": "of other weights"}) == {}
    path.write_text("{")
    assert earlier(path, "runs", **same) == {}


def test_a_training_of_other_settings_or_pairs_is_not_taken_for_this_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previously, the checkpoint of any previous training was resumed: with no steps left, the old weights were
    evaluated again, and recorded as those of the new settings."""
    resumed: list[bool] = []

    def train(settings: FinetuneSettings, out: Path, data: Path) -> Path:
        resumed.append((out / "checkpoint.pt").exists())
        (out / "checkpoint.pt").touch()
        return out / "weights.safetensors"

    network = SimpleNamespace(settings=SimpleNamespace(preset="small"))
    for name in ("simulate", "open_source", "prepare", "generate"):
        monkeypatch.setattr(finetune, name, lambda *given, **named: None)
    monkeypatch.setattr(finetune, "PairSet", lambda root, pairs, *rest: pairs)
    monkeypatch.setattr(finetune, "errors", lambda pairs, model: {**BEFORE, "pairs": pairs})
    monkeypatch.setattr(finetune, "load_model", lambda path: network)
    monkeypatch.setattr(finetune, "finetune", train)
    options = Options(out=tmp_path, cache=tmp_path / "cache", repetitions=1, only="pairs", pairs=5)
    finetune.bench_finetune(options)
    finetune.bench_finetune(options)  # all is in the file
    assert resumed == [False]
    found = finetune.bench_finetune(replace(options, pairs=6)).results
    assert resumed == [False, True]  # the same training, evaluated on other pairs
    assert found["before"]["new"]["pairs"] == found["runs"]["pairs"]["0"]["after"]["new"]["pairs"] == 12
    found = finetune.bench_finetune(replace(options, overrides=("radius=3",))).results
    assert resumed == [False, True, False]
    assert found["settings"]["radius"] == 3
