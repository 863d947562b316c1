# SPDX-License-Identifier: Apache-2.0
"""DeepPointMap2's table 2 and figure 6: a camera with black images, and a box in front of the LiDAR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dpm2_core.config import load_settings
from dpm2_core.data.corrupt import CorruptedSource, parse_corruption
from dpm2_core.data.source import Source, frame_at
from dpm2_core.evaluation.figures import corrupted_png
from dpm2_core.experiments.kitti import ORIGINAL_POSES, PAPER, TESTED
from dpm2_core.experiments.request import Experiment, Findings, Request, draw_if_possible
from dpm2_core.experiments.sequences import (
    FAILED,
    SHOWN,
    add_runs,
    own_part,
    paper_notes,
    present,
    reading,
    registrations,
    run_folders,
    segments,
)
from dpm2_core.experiments.slam_part import open_drive
from dpm2_core.experiments.table import MEAN, ResultTable
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.settings import Config

SHARES = (0.05, 0.3, 0.5, 1.0)
"""Fractions of the frames that are corrupted."""
KINDS = {"camera": "camera black", "obstruction": "box before the LiDAR"}
_PAPER_MEAN = {"camera": (0.62, 0.61, 0.69, 1.04), "obstruction": (0.62, 0.66, 0.71, 0.74)}
"""Mean t_err of 06 to 10, percent, of the paper's table 2."""
_DRAWN_FRAME = 4
"""Position of the frame that is drawn."""


def _variants(request: Request) -> list[tuple[str, list[str], str | None]]:
    """Name, settings and corruption of every row."""
    rows: list[tuple[str, list[str], str | None]] = []
    for name, settings in registrations(request):
        rows.append((f"{name}, whole", settings, None))
        for kind, label in KINDS.items():
            if kind == "camera" and not _uses_images(request, settings):
                continue
            rows += [(f"{name}, {label} {share:.0%}", settings, f"{kind}={share},seed=0") for share in SHARES]
    return rows


def _uses_images(request: Request, settings: Sequence[str]) -> bool:
    """Whether there are images, and a camera would be used: if not, black images change nothing."""
    weights = [] if request.weights is None else [f"slam.neural.weights={request.weights}"]
    config = load_settings(Config, None, [*settings, *weights, *request.overrides])
    return make_odometry(config.slam).uses_images and _has_images(request)


def _has_images(request: Request) -> bool:
    """Whether the first frame of a sequence has an image."""
    sources = (_open_sequence(request, sequence) for sequence in present(request, TESTED, ORIGINAL_POSES))
    return any(frame_at(source, 0).images for source in sources)


def _open_sequence(request: Request, sequence: str) -> Source:
    return open_drive(request.data, reading(request, sequence, ORIGINAL_POSES))


def _parts(request: Request) -> Sequence[Sequence[Part]]:
    sequences = present(request, TESTED, ORIGINAL_POSES)
    return [
        [
            own_part(name, sequence, request, [*ORIGINAL_POSES, *settings], corrupt=corrupt)
            for name, settings, corrupt in _variants(request)
            for sequence in sequences
        ]
    ]


def _findings(request: Request, figures: Mapping[str, Figures]) -> Findings:
    sequences = present(request, TESTED, ORIGINAL_POSES)
    over = f"KITTI metric, mean over {segments(request)}"
    caption = f"{over}; change: of the mean t_err from the whole row. Hit frames are drawn with seed 0. {FAILED}"
    table = ResultTable("Failing sensors: t_err % / r_err deg per 100 m", [*sequences, MEAN], SHOWN, caption)
    variants = _variants(request)
    changes: dict[str, float | None] = {}
    baseline: float | None = None
    for name, _, corrupt in variants:
        add_runs(table, name, sequences, figures)
        mean = table.rows[-1].cells[MEAN]["t_err_percent"]
        baseline = mean if corrupt is None else baseline
        change = 100 * (mean / baseline - 1) if mean is not None and baseline else None
        if corrupt is not None:
            changes[name] = change
            row_notes = ["" if change is None else f"{change:+.0f} %", table.rows[-1].note]
            table.rows[-1] = replace(table.rows[-1], note="; ".join(filter(None, row_notes)))
    table.add("DeepPointMap2, whole", PAPER, "the paper")
    for kind, means in _PAPER_MEAN.items():
        for share, mean in zip(SHARES, means, strict=True):
            table.add(f"DeepPointMap2, {KINDS[kind]} {share:.0%}", {MEAN: {"t_err_percent": mean}}, "the paper",
                      f"{100 * (mean / 0.60 - 1):+.0f} %")  # fmt: skip
    notes = paper_notes(request, sequences, TESTED)
    if set(sequences) != set(TESTED):
        notes.append(f"the paper's means are over the sequences {', '.join(TESTED)}")
    if not any(corrupt and corrupt.startswith("camera") for _, _, corrupt in variants):
        notes.append("no rows with a black camera: there are no images, or this configuration does not use them")
    runs = run_folders([name for name, _, _ in variants], sequences, request.out)
    _draw_corrupted(request, sequences[0], notes)
    return Findings([table], notes, runs, {"change_percent": changes})


def _draw_corrupted(request: Request, sequence: str, notes: list[str]) -> None:
    """The paper's figure 6: a frame as it is, and with both sensors corrupted."""
    source = _open_sequence(request, sequence)
    position = min(_DRAWN_FRAME, len(source) - 1)
    corrupted = CorruptedSource(source, parse_corruption("camera=1,obstruction=1,seed=0"))
    before, after = (frame_at(each, position) for each in (source, corrupted))
    path = request.out / f"corrupted_{sequence}.png"
    title = f"{sequence}, frame {before.index}: camera black, box before the LiDAR"
    draw_if_possible(path, notes, lambda to: corrupted_png(to, before, after, title))


ROBUSTNESS = Experiment(frozenset({"weights", "registrations", "lengths", "frames"}), _parts, _findings)
