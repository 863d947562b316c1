# SPDX-License-Identifier: Apache-2.0
"""DeepPointMap2's tables 3 and 4 and figure 7: networks that differ in one thing, fine-tuned alike, tested by SLAM."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dpm2_core.config import load_settings
from dpm2_core.data.source import frame_at
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.image_attention import attention_png, image_attention
from dpm2_core.experiments.ablation import TABLE_4 as TRAINED_ALIKE
from dpm2_core.experiments.kitti import ORIGINAL_POSES, TESTED
from dpm2_core.experiments.request import Experiment, Findings, Request, drawn
from dpm2_core.experiments.sequences import (
    FAILED,
    SHOWN,
    add_runs,
    learned_note,
    own_part,
    paper_notes,
    present,
    reading,
    run_folders,
    segments,
)
from dpm2_core.experiments.slam_part import drive_content, open_drive
from dpm2_core.experiments.table import MEAN, ResultTable
from dpm2_core.experiments.variant_part import DRIVE, PACK, TRAIN, training_of
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.learning.checkpoint import WEIGHTS
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.weights import load_model
from dpm2_core.slam.settings import Config

LEARNED = ("00", "01", "02", "03", "04", "05")
AS_PAPER: dict[str, Any] = {
    "fusion": {"reference": "fps", "reference_features": False, "relative": False, "pixel": False}
}
"""What all variants have in common, except for what a variant changes: only the fusion determines where a reference
point is, and what is there."""
_POINTS = 256
"""Reference points of a variant without a number: Table 4 of the paper has the figures of this number in Table 3."""
TABLE_3: dict[str, dict[str, Any]] = {
    "FPS 128": {"fusion": {"points": 128}},
    "FPS 256": {},
    "FPS 512": {"fusion": {"points": 512}},
    "FPS and edges 256": {"fusion": {"reference": "salient", "corners": 0}},
    "FPS, edges and image corners 256": {"fusion": {"reference": "salient", "corners": 0.25}},
    "uniform 256": {"fusion": {"reference": "uniform"}},
    "uniform 4096": {"fusion": {"reference": "uniform", "points": 4096}},
    "normal 256": {"fusion": {"reference": "normal"}},
    "normal 4096": {"fusion": {"reference": "normal", "points": 4096}},
}
_PAPER_3 = {
    "FPS 128": (0.49, None, 0.94, 0.85, None), "FPS 256": (0.47, 0.39, 0.77, 0.62, 0.75),
    "FPS 512": (0.57, None, 0.88, 0.74, None),
}  # fmt: skip
_PAPER_4 = {
    "biased attention": (0.47, 0.39, 0.77, 0.62, 0.75), "PointPainting": (0.56, 0.56, 1.15, 0.94, 1.55),
    "RoI pooling 3x3": (2.34, 1.56, 4.12, 4.24, 17.83), "scale-dot attention": (2.73, 1.00, 9.63, 6.48, 6.48),
    "without learnable": (0.72, 0.46, 18.00, 1.16, 1.21), "without spatial": (41.5, 21.5, 29.9, 26.3, 20.9),
}  # fmt: skip
TABLE_4 = {name: TRAINED_ALIKE[name] for name in _PAPER_4}
_FOR_SLAM = ("slam.", "input.")  # settings of the user that are not of the training
_ALONE = ("slam.registration=neural", "slam.visual.enabled=false")  # the network alone, as in the paper


@dataclass(frozen=True)
class VariantTable:
    """Variants of a network by name; `paper`: t_err of 06 to 10 of each, percent. `judged` False: only images."""

    title: str
    variants: Mapping[str, Mapping[str, Any]]
    paper: Mapping[str, Sequence[float | None]]
    judged: bool = True

    def experiment(self) -> Experiment:
        """The experiment for the registry."""
        uses = {"learn", "weights", "config", *(("lengths", "frames") if self.judged else ())}
        return Experiment(frozenset(uses), self.parts, self.findings)

    def parts(self, request: Request) -> Sequence[Sequence[Part]]:
        """Packed drives, a training of each variant, and a run of each on every sequence.

        Raises:
            UsageError: no such sequences or weights, or invalid settings of the training; raised before packing.
        """
        sequences = present(request, TESTED, ORIGINAL_POSES)
        start = request.weights or "small"
        packs = []
        for sequence in _learned(request):
            asked = reading(request, sequence)
            of = {"data": request.data, "weights": start, "settings": asked}
            content = drive_content(request.data, asked)
            packs.append(Part(f"packed/{sequence}", PACK, of, [weights_path(start)], content=content))
        training: dict[str, Any] = {
            "config": request.config,
            "settings": [text for text in request.overrides if not text.startswith(_FOR_SLAM)],
            "start": start,
        }
        training_of(**training, network={}, packed=())
        _check_drive(request)
        arguments = {"training": training, "packed": [request.out / pack.name / DRIVE for pack in packs]}
        content = " ".join(pack.content for pack in packs)
        inputs = [weights_path(start), *request.config_files]
        trained = [
            Part(self._training(name), TRAIN, {**arguments, "network": _joined(change)}, inputs, content=content)
            for name, change in self.variants.items()
        ]
        stages: list[list[Part]] = [packs, trained]
        if self.judged:
            stages.append([self._run(request, v, sequence) for v in self.variants for sequence in sequences])
        return stages

    def findings(self, request: Request, figures: Mapping[str, Figures]) -> Findings:
        """The table, and the panel of attention maps."""
        sequences = present(request, TESTED, ORIGINAL_POSES)
        notes = learned_note(_learned(request), sequences)
        tables = []
        if self.judged:
            caption = f"t_err % / r_err deg per 100 m, mean over {segments(request)}, network alone. {FAILED}"
            table = ResultTable(self.title, [*sequences, MEAN], SHOWN, caption)
            for variant in self.variants:
                random = len(figures[self._training(variant)]["random_at_start"])
                about = f"{random} tensors began at random" if random else ""
                add_runs(table, self._name(variant), sequences, figures, variant, about)
            for variant, row in self.paper.items():
                table.add(variant, {s: {"t_err_percent": t} for s, t in zip(TESTED, row, strict=True)}, "the paper")
            tables.append(table)
            notes.append("every variant was fine-tuned from the same weights, as far as they fit it")
            notes += paper_notes(request, sequences, TESTED)
        names = [self._name(variant) for variant in self.variants] if self.judged else []
        runs = run_folders(names, sequences, request.out)
        if self.variants is not TABLE_3:
            self._panel(request, sequences[0], notes)
        return Findings(tables, notes, runs)

    def _run(self, request: Request, variant: str, sequence: str) -> Part:
        weights = request.out / self._training(variant) / WEIGHTS
        own = replace(request, weights=str(weights), overrides=_for_slam(request))
        return own_part(self._name(variant), sequence, own, [*ORIGINAL_POSES, *_ALONE])

    def _panel(self, request: Request, sequence: str, notes: list[str]) -> None:
        """The paper's figure 7: attention of one reference point to the image, for every variant with attention."""
        frame = frame_at(open_drive(request.data, reading(request, sequence)), 0)
        if not frame.images:
            notes.append("no attention maps: the data set has no images")
            return
        looked = {}
        for variant in self.variants:
            model = load_model(request.out / self._training(variant) / WEIGHTS)
            try:
                looked[variant] = image_attention(model, frame)
            except UsageError as error:  # pooling and painting have no attention
                notes.append(f"no attention map of {variant}: {error}")
        title = f"{sequence}, frame {frame.index}: attention of one reference point"
        path = request.out / f"attention_{sequence}.png"
        drawn(path, notes, lambda to: attention_png(to, looked, title))

    def _name(self, variant: str) -> str:
        return f"variant {variant}"

    def _training(self, variant: str) -> str:
        return f"trained/{variant.replace(' ', '_')}"


def _for_slam(request: Request) -> tuple[str, ...]:
    return tuple(text for text in request.overrides if text.startswith(_FOR_SLAM))


def _check_drive(request: Request) -> None:
    """Check that each variant is run with its own weights: else every row would be of the same weights, or of none.

    Raises:
        UsageError: the user's settings replace those of a variant.
    """
    own = "those of the variant"
    slam = load_settings(Config, None, [*_ALONE, f"slam.neural.weights={own}", *_for_slam(request)]).slam
    if slam.neural.weights != own:
        raise UsageError(f"slam.neural.weights={slam.neural.weights}: each variant is driven with its own weights;"
                         " what all start from is named by --weights")  # fmt: skip
    if slam.registration != "neural":
        raise UsageError(f"slam.registration={slam.registration}: the variants are driven with the network alone")


def _joined(change: Mapping[str, Any]) -> dict[str, Any]:
    return {"fusion": {"points": _POINTS, **AS_PAPER["fusion"], **change.get("fusion", {})}}


def _learned(request: Request) -> list[str]:
    """The sequences to learn from: the requested ones, or those of the paper that the data set has."""
    return present(replace(request, sequences=request.learn), LEARNED)


reference_points = VariantTable("Table 3: reference points", TABLE_3, _PAPER_3).experiment()
fusion = VariantTable("Table 4: fusion of LiDAR and image", TABLE_4, _PAPER_4).experiment()
attention = VariantTable("Figure 7: attention maps", TABLE_4, {}, judged=False).experiment()
