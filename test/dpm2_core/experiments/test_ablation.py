# SPDX-License-Identifier: Apache-2.0
"""The comparison of fusions: every alternative is trained and evaluated, and a stopped comparison continues."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.evaluation.pair_set import PairSet
from dpm2_core.experiments.ablation import MIXTURES, TABLE_4, AblationSettings, ablation, ablation_tables, gains
from dpm2_core.learning.dataset import DataSettings
from dpm2_core.learning.registration_loss import LossSettings
from dpm2_core.learning.train_registration import RegistrationTrainingSettings
from dpm2_core.learning.trainer import OptimizerSettings

from ...helpers.networks import tiny


def quick(packed: Path) -> RegistrationTrainingSettings:
    """Settings of one step with a tiny network."""
    return RegistrationTrainingSettings(
        network=tiny().model_dump(),
        data=DataSettings(packed={str(packed): 1.0}, groups=1, frames=2, workers=0, images=True),
        loss=LossSettings(near=8, own=4),
        pairs=1,
        sets=0,
        optimiser=OptimizerSettings(steps=1, compile=False, bf16=False, warmup=0),
    )


@pytest.mark.long
def test_every_alternative_is_trained_and_measured_once(packed: Path, tmp_path: Path) -> None:
    """All of tables 3 and 4; a second call trains and evaluates nothing and returns the same figures."""
    training = quick(packed)
    settings = AblationSettings(training=training, measure={"same": str(packed)}, pairs=2)
    table = ablation(settings, tmp_path)
    assert list(table) == [*TABLE_4, *MIXTURES]
    assert all(0 <= value <= 1 for row in table.values() for value in row["same"]["near_success"])
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("weights.safetensors")}
    assert json.dumps(ablation(settings, tmp_path)) == json.dumps(table)  # NaN is not equal to itself
    assert {path: path.stat().st_mtime_ns for path in times} == times


@pytest.mark.slow
def test_seeds_are_trainings_of_their_own(packed: Path, tmp_path: Path) -> None:
    """The second seed begins with other weights; another number of pairs is evaluated without a new training. Seeds
    count from that of the settings: `--set training.optimiser.seed=1` returned the figures of seed 0 again."""
    variants = {"no camera": {"image": {"backbone": "none"}}}
    settings = AblationSettings(
        training=quick(packed), variants=variants, seeds=2, measure={"same": str(packed)}, pairs=2
    )
    (row,) = ablation(settings, tmp_path).values()
    first, second = row["same"]["near_m"]
    assert first != second
    seeded = settings.training.optimiser.model_copy(update={"seed": 1})
    after = settings.training.model_copy(update={"optimiser": seeded})
    (row,) = ablation(settings.model_copy(update={"training": after, "seeds": 1}), tmp_path / "after").values()
    assert row["same"]["near_m"] == [pytest.approx(second)]
    weights = sorted((tmp_path / "no_camera").rglob("weights.safetensors"))
    times = [path.stat().st_mtime_ns for path in weights]
    assert len(weights) == 2
    ablation(settings.model_copy(update={"pairs": 4}), tmp_path)
    assert [path.stat().st_mtime_ns for path in weights] == times
    optimiser = settings.training.optimiser.model_copy(update={"rate": 0.1})
    other = settings.model_copy(update={"training": settings.training.model_copy(update={"optimiser": optimiser})})
    (row,) = ablation(other, tmp_path).values()
    assert not set(row["same"]["near_m"]) & {first, second}, "figures of the training before"


@pytest.mark.slow
def test_a_training_that_is_stopped_while_it_is_measured_is_measured_again(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previously, figures of the previous training remained next to the new weights, and were printed as theirs."""
    variants = {"no camera": {"image": {"backbone": "none"}}}
    settings = AblationSettings(
        training=quick(packed), variants=variants, seeds=1, measure={"same": str(packed)}, pairs=2
    )
    (before,) = ablation(settings, tmp_path).values()
    optimiser = settings.training.optimiser.model_copy(update={"rate": 0.1})
    other = settings.model_copy(update={"training": settings.training.model_copy(update={"optimiser": optimiser})})

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(PairSet, "measure", stopped)
        with pytest.raises(KeyboardInterrupt):
            ablation(other, tmp_path)
    (after,) = ablation(other, tmp_path).values()
    assert after["same"]["near_m"] != before["same"]["near_m"]


@pytest.mark.slow
def test_other_drives_in_a_folder_are_learned_from_and_measured_anew(
    packed: Path, samples: list[Sample], tmp_path: Path
) -> None:
    """Drives that changed are used for training and evaluation again. Previously, the record contained figures of
    drives that no longer existed."""
    measured, out = tmp_path / "val", tmp_path / "out"
    write_packed(measured / "world", samples, {"source": "boxes"})
    variants = {"no camera": {"image": {"backbone": "none"}}}
    settings = AblationSettings(
        training=quick(packed), variants=variants, seeds=1, measure={"unseen": str(measured)}, pairs=2
    )
    (before,) = ablation(settings, out).values()
    (weights,) = out.rglob("weights.safetensors")
    trained = weights.stat().st_mtime_ns
    write_packed(measured / "another", samples[::2], {"source": "boxes"})
    (after,) = ablation(settings, out).values()
    assert after["unseen"]["near_m"] != before["unseen"]["near_m"]
    assert weights.stat().st_mtime_ns == trained
    write_packed(packed / "another", samples[::2], {"source": "boxes"})
    ablation(settings, out)
    assert weights.stat().st_mtime_ns > trained


def test_a_gain_is_of_the_same_seeds() -> None:
    """Each seed of a variant is compared with the same seed of the first variant; an error improves by falling."""
    table = {
        "first": {"town": {"near_m": [0.2, 0.4], "near_success": [0.5, 0.7], "chi2": [1.0, 1.0]}},
        "other": {"town": {"near_m": [0.1, 0.2], "near_success": [0.6, 0.8], "chi2": [9.0, 9.0]}},
    }
    found = gains(table)
    assert found.keys() == {"other"}
    assert found["other"]["town"].keys() == {"near_m", "near_success"}
    success = found["other"]["town"]["near_success"]
    assert success["mean"] == pytest.approx(0.1 / 0.6)
    assert success["low"] == pytest.approx(success["high"])  # both seeds have the same gain
    assert found["other"]["town"]["near_m"]["mean"] == pytest.approx(0.5)
    console = Console(width=120, record=True, file=io.StringIO())
    for shown in ablation_tables(table):
        console.print(shown)
    assert "+16.7%" in console.export_text()
