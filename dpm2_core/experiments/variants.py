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
from dpm2_core.experiments.request import Experiment, Findings, Request, draw_if_possible
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
_DEFAULT_POINTS = 256
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
_SLAM_PREFIXES = ("slam.", "input.")  # settings of the user that are not of the training
_NETWORK_ONLY = ("slam.registration=neural", "slam.visual.enabled=false")  # the network alone, as in the paper


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
        for sequence in _training_sequences(request):
            drive_settings = reading(request, sequence)
            pack_arguments = {"data": request.data, "weights": start, "settings": drive_settings}
            content = drive_content(request.data, drive_settings)
            packs.append(Part(f"packed/{sequence}", PACK, pack_arguments, [weights_path(start)], content=content))
        training: dict[str, Any] = {
            "config": request.config,
            "settings": [text for text in request.overrides if not text.startswith(_SLAM_PREFIXES)],
            "start": start,
        }
        training_of(**training, network={}, packed=())
        _check_slam_settings(request)
        arguments = {"training": training, "packed": [request.out / pack.name / DRIVE for pack in packs]}
        content = " ".join(pack.content for pack in packs)
        inputs = [weights_path(start), *request.config_files]
        trained = [
            Part(
                self._training_name(name),
                TRAIN,
                {**arguments, "network": _with_common_changes(change)},
                inputs,
                content=content,
            )
            for name, change in self.variants.items()
        ]
        stages: list[list[Part]] = [packs, trained]
        if self.judged:
            stages.append([self._run_part(request, v, sequence) for v in self.variants for sequence in sequences])
        return stages

    def findings(self, request: Request, figures: Mapping[str, Figures]) -> Findings:
        """The table, and the panel of attention maps."""
        sequences = present(request, TESTED, ORIGINAL_POSES)
        notes = learned_note(_training_sequences(request), sequences)
        tables = []
        if self.judged:
            caption = f"t_err % / r_err deg per 100 m, mean over {segments(request)}, network alone. {FAILED}"
            table = ResultTable(self.title, [*sequences, MEAN], SHOWN, caption)
            for variant in self.variants:
                random = len(figures[self._training_name(variant)]["random_at_start"])
                about = f"{random} tensors began at random" if random else ""
                add_runs(table, self._row_name(variant), sequences, figures, variant, about)
            for variant, row in self.paper.items():
                table.add(variant, {s: {"t_err_percent": t} for s, t in zip(TESTED, row, strict=True)}, "the paper")
            tables.append(table)
            notes.append("every variant was fine-tuned from the same weights, as far as their tensors fit it")
            notes += paper_notes(request, sequences, TESTED)
        names = [self._row_name(variant) for variant in self.variants] if self.judged else []
        runs = run_folders(names, sequences, request.out)
        if self.variants is not TABLE_3:
            self._draw_attention(request, sequences[0], notes)
        return Findings(tables, notes, runs)

    def _run_part(self, request: Request, variant: str, sequence: str) -> Part:
        weights = request.out / self._training_name(variant) / WEIGHTS
        variant_request = replace(request, weights=str(weights), overrides=_slam_overrides(request))
        return own_part(self._row_name(variant), sequence, variant_request, [*ORIGINAL_POSES, *_NETWORK_ONLY])

    def _draw_attention(self, request: Request, sequence: str, notes: list[str]) -> None:
        """The paper's figure 7: attention of one reference point to the image, for every variant with attention."""
        frame = frame_at(open_drive(request.data, reading(request, sequence)), 0)
        if not frame.images:
            notes.append("no attention maps: the data set has no images")
            return
        attentions = {}
        for variant in self.variants:
            model = load_model(request.out / self._training_name(variant) / WEIGHTS)
            try:
                attentions[variant] = image_attention(model, frame)
            except UsageError as error:  # pooling and painting have no attention
                notes.append(f"no attention map of {variant}: {error}")
        title = f"{sequence}, frame {frame.index}: attention of one reference point"
        path = request.out / f"attention_{sequence}.png"
        draw_if_possible(path, notes, lambda to: attention_png(to, attentions, title))

    def _row_name(self, variant: str) -> str:
        return f"variant {variant}"

    def _training_name(self, variant: str) -> str:
        return f"trained/{variant.replace(' ', '_')}"


def _slam_overrides(request: Request) -> tuple[str, ...]:
    return tuple(text for text in request.overrides if text.startswith(_SLAM_PREFIXES))


def _check_slam_settings(request: Request) -> None:
    """Check that each variant is run with its own weights: else every row would be of the same weights, or of none.

    Raises:
        UsageError: the user's settings replace those of a variant.
    """
    placeholder = "those of the variant"
    slam = load_settings(
        Config, None, [*_NETWORK_ONLY, f"slam.neural.weights={placeholder}", *_slam_overrides(request)]
    ).slam
    if slam.neural.weights != placeholder:
        raise UsageError(f"slam.neural.weights={slam.neural.weights}: each variant is run with its own weights;"
                         " give the weights that all start from by --weights")  # fmt: skip
    if slam.registration != "neural":
        raise UsageError(f"slam.registration={slam.registration}: the variants are run with the network alone (neural)")


def _with_common_changes(change: Mapping[str, Any]) -> dict[str, Any]:
    return {"fusion": {"points": _DEFAULT_POINTS, **AS_PAPER["fusion"], **change.get("fusion", {})}}


def _training_sequences(request: Request) -> list[str]:
    """The sequences to learn from: the requested ones, or those of the paper that the data set has."""
    return present(replace(request, sequences=request.learn), LEARNED)


reference_points = VariantTable("Table 3: reference points", TABLE_3, _PAPER_3).experiment()
fusion = VariantTable("Table 4: fusion of LiDAR and image", TABLE_4, _PAPER_4).experiment()
attention = VariantTable("Figure 7: attention maps", TABLE_4, {}, judged=False).experiment()
