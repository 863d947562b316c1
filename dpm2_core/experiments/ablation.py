# SPDX-License-Identifier: Apache-2.0
"""The paper's Table 4: alternatives of the fusion, trained alike and measured on the same unseen pairs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import Field

from dpm2_core.config import Settings, merged
from dpm2_core.evaluation.pair_set import PairSet
from dpm2_core.learning.train_registration import RegistrationTrainingSettings, train_registration
from dpm2_core.network.weights import load_model

TABLE_4: dict[str, dict[str, Any]] = {
    "biased attention": {},
    "PointPainting": {"fusion": {"kind": "point_painting"}},
    "RoI pooling 3x3": {"fusion": {"kind": "roi_pooling"}},
    "scale-dot attention": {"fusion": {"kind": "scale_dot"}},
    "without learnable": {"fusion": {"kind": "without_learnable"}},
    "without spatial": {"fusion": {"kind": "without_spatial"}},
    "biased attention, own pixel": {"fusion": {"pixel": True}},
    "no camera": {"image": {"backbone": "none"}},
}


class AblationSettings(Settings):
    """A comparison of networks that differ in one thing."""

    training: RegistrationTrainingSettings = RegistrationTrainingSettings()
    """Of every variant; each changes its network."""
    variants: dict[str, dict[str, Any]] = TABLE_4
    """Name and change to the network of each."""
    measure: dict[str, str] = Field({})
    """Name and folder of the packed drives that all are measured on."""
    pairs: int = Field(300, gt=0)
    """Frame pairs of each."""


def ablation(
    settings: AblationSettings, out: Path, progress: Callable[[str, dict[str, Any]], None] = lambda name, row: None
) -> dict[str, dict[str, Any]]:
    """Train and measure every variant; one that was trained before, in `out`, is only measured.

    Returns:
        Figures of `PairSet.measure` by variant and by drives.
    """
    table: dict[str, dict[str, Any]] = {}
    for name, change in settings.variants.items():
        training = settings.training.model_copy(update={"network": merged(settings.training.network, change)})
        folder = out / name.replace(" ", "_")
        weights = folder / "weights.safetensors"
        if not weights.exists():
            train_registration(training, folder, resume=(folder / "checkpoint.pt").exists())
        model = load_model(weights)
        images = training.data.images and model.encoder.image is not None
        table[name] = {
            drives: PairSet(Path(folder_of), settings.pairs, model.settings, images).measure(model)
            for drives, folder_of in settings.measure.items()
        }
        progress(name, table[name])
    return table
