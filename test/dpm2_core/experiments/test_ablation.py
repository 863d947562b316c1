# SPDX-License-Identifier: Apache-2.0
"""The comparison of fusions: every alternative trains and is measured, and a stopped comparison goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from dpm2_core.experiments.ablation import TABLE_4, AblationSettings, ablation
from dpm2_core.learning.dataset import DataSettings
from dpm2_core.learning.registration_loss import LossSettings
from dpm2_core.learning.train_registration import RegistrationTrainingSettings
from dpm2_core.learning.trainer import OptimizerSettings

from ...helpers.networks import tiny


@pytest.mark.slow
def test_every_alternative_is_trained_and_measured_once(packed: Path, tmp_path: Path) -> None:
    """All of Table 4; a second call trains nothing and finds the same figures."""
    training = RegistrationTrainingSettings(
        network=tiny().model_dump(),
        data=DataSettings(packed={str(packed): 1.0}, groups=1, frames=2, workers=0, images=True),
        loss=LossSettings(near=8, own=4),
        pairs=1,
        sets=0,
        optimiser=OptimizerSettings(steps=1, compile=False, bf16=False, warmup=0),
    )
    settings = AblationSettings(training=training, measure={"same": str(packed)}, pairs=2)
    seen: list[str] = []
    table = ablation(settings, tmp_path, lambda name, row: seen.append(name))
    assert seen == list(TABLE_4)
    assert all(0 <= row["same"]["near_success"] <= 1 for row in table.values())
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("weights.safetensors")}
    again = ablation(settings, tmp_path)
    assert {n: row["same"]["far_m"] for n, row in again.items()} == {
        n: row["same"]["far_m"] for n, row in table.items()
    }
    assert {path: path.stat().st_mtime_ns for path in times} == times
