# SPDX-License-Identifier: Apache-2.0
"""The paper's tables 3 and 4: alternatives of the fusion and of its reference points, trained in the same way with
several seeds, and measured on the same unseen pairs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from statistics import mean
from typing import Any

from pydantic import Field

from dpm2_core.config import Settings, merged
from dpm2_core.data.packed import open_packed, packed_digest
from dpm2_core.evaluation.pair_set import PairSet
from dpm2_core.experiments.paired import Gain, paired_gain
from dpm2_core.files import atomic_write
from dpm2_core.learning.begun import begin_training
from dpm2_core.learning.checkpoint import WEIGHTS
from dpm2_core.learning.train_registration import RegistrationTrainingSettings, train_registration
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.weights import load_model
from dpm2_core.tables import FigureTable

FIRST = "biased attention"
"""The variant that the others are compared with."""
TABLE_4: dict[str, dict[str, Any]] = {
    FIRST: {},
    "PointPainting": {"fusion": {"kind": "point_painting"}},
    "RoI pooling 3x3": {"fusion": {"kind": "roi_pooling"}},
    "scale-dot attention": {"fusion": {"kind": "scale_dot"}},
    "without learnable": {"fusion": {"kind": "without_learnable"}},
    "without spatial": {"fusion": {"kind": "without_spatial"}},
    "biased attention, own pixel": {"fusion": {"pixel": True}},
    "no camera": {"image": {"backbone": "none"}},
}
MIXTURES: dict[str, dict[str, Any]] = {
    "farthest points": {"fusion": {"reference": "fps"}},
    "farthest points, edges": {"fusion": {"reference": "salient", "corners": 0}},
    "farthest points, edges, twice the corners": {"fusion": {"reference": "salient", "corners": 0.5}},
}
"""Reference points other than those of the presets."""


class AblationSettings(Settings):
    """A comparison of networks that differ in one thing."""

    training: RegistrationTrainingSettings = RegistrationTrainingSettings()
    """Training of every variant; each variant changes its network."""
    variants: dict[str, dict[str, Any]] = Field({**TABLE_4, **MIXTURES}, min_length=1)
    """Name and change to the network of each; the others are compared with the first."""
    seeds: int = Field(1, gt=0)
    """Trainings of each variant, with `training.optimiser.seed` and the seeds after it."""
    measure: dict[str, str] = Field({})
    """Name and folder of the packed drives on which all variants are measured."""
    pairs: int = Field(300, gt=0)
    """Frame pairs of each of these."""


COMPARED = ("near_m", "near_success", "far_success", "turned_success")
"""Figures for which the gain is reported."""
Table = dict[str, dict[str, dict[str, list[float]]]]
"""Figures of `PairSet.measure` by variant and drives: one value per seed."""


def ablation(settings: AblationSettings, out: Path) -> Table:
    """Train and measure every variant; trainings and measurements with the same settings in `out` are not repeated.

    All variants of a seed are trained before the next seed, so that a stopped ablation already has a comparison.
    """
    table: Table = {name: {drives: {} for drives in settings.measure} for name in settings.variants}
    for seed in range(settings.seeds):
        for name in settings.variants:
            for drives, figures in _train_and_measure(settings, name, seed, out).items():
                for figure, value in figures.items():
                    table[name][drives].setdefault(figure, []).append(value)
    return table


def _train_and_measure(settings: AblationSettings, name: str, seed: int, out: Path) -> dict[str, dict[str, float]]:
    """Figures by drives of one training."""
    network = merged(settings.training.network, settings.variants[name])
    base = settings.training.optimiser
    optimiser = base.model_copy(update={"seed": base.seed + seed})
    training = settings.training.model_copy(update={"network": network, "optimiser": optimiser})
    folder = out / name.replace(" ", "_") / str(seed)
    weights, figures_file = folder / WEIGHTS, folder / "figures.json"
    request = {"measure": settings.measure, "content": _digests(settings.measure.values()), "pairs": settings.pairs}
    inputs = [weights_path(training.start)] if training.start else []
    begin_training(folder, training, inputs, {"content": _digests(training.data.packed)})
    if (
        weights.exists()
        and figures_file.exists()
        and (stored := json.loads(figures_file.read_text()))["asked"] == request
    ):
        return dict(stored["figures"])
    if not weights.exists():
        figures_file.unlink(missing_ok=True)  # figures of earlier weights: a stopped measurement is repeated
        train_registration(training, folder)
    model = load_model(weights)
    images = training.data.images and model.encoder.image is not None
    figures = {
        drives: PairSet(Path(folder_of), settings.pairs, model.settings, images).measure(model)
        for drives, folder_of in settings.measure.items()
    }
    with atomic_write(figures_file) as file:
        file.write(json.dumps({"asked": request, "figures": figures}))
    return figures


def _digests(folders: Iterable[str]) -> list[str]:
    """Digests of folders of packed drives, so that other drives in their place are detected."""
    return [f"{folder}: {packed_digest(open_packed(Path(folder)))}" for folder in folders]


def gains(table: Table) -> dict[str, dict[str, dict[str, Any]]]:
    """The gain of each variant over the first one, paired by seed: `Gain` by variant, drives and figure."""
    first, *others = table
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for name in others:
        for drives, figures in table[name].items():
            for figure in (key for key in COMPARED if key in figures):
                gain = paired_gain(table[first][drives][figure], figures[figure], not figure.endswith("success"))
                if gain is not None:
                    found.setdefault(name, {}).setdefault(drives, {})[figure] = asdict(gain)
    return found


def ablation_tables(table: Table) -> Iterator[FigureTable]:
    """A table to print for each set of drives: means over the seeds, and the gain over the first variant."""
    first, *_ = table
    found = gains(table)
    for drives in table[first]:
        columns = ["near m", "near", "far", "turned"]
        figure_table = FigureTable(
            drives, names=["variant"], figures=columns, text=[f"near pairs that are right, compared with {first}"]
        )
        for name, rows in table.items():
            row = {figure: mean(values) for figure, values in rows[drives].items()}
            gain = found.get(name, {}).get(drives, {}).get("near_success")
            figure_table.add_row(
                name, *(_cell(row, figure) for figure in COMPARED), "" if gain is None else str(Gain(**gain))
            )
        yield figure_table


def _cell(row: dict[str, float], figure: str) -> str:
    if figure not in row:
        return ""
    return f"{row[figure]:.3f}" if figure.endswith("_m") else f"{row[figure]:.0%}"
