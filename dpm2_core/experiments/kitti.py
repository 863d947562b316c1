# SPDX-License-Identifier: Apache-2.0
"""DeepPointMap2's table 1, KITTI, and its KITTI-360 trajectories: our SLAM and other programs on every sequence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from dpm2_core.evaluation.figures import trajectories_png
from dpm2_core.evaluation.run_folder import read_run
from dpm2_core.evaluation.run_page import aligned
from dpm2_core.experiments.request import Experiment, Findings, Request, draw_if_possible
from dpm2_core.experiments.sequences import (
    FAILED,
    SHOWN,
    add_runs,
    own_part,
    paper_notes,
    peer_names,
    peer_parts,
    present,
    registrations,
    run_folders,
    segments,
)
from dpm2_core.experiments.table import MEAN, Cells, ResultTable
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.frame import Array

USES = frozenset({"weights", "registrations", "peers", "lengths", "frames"})
TESTED = ("06", "07", "08", "09", "10")
"""Test sequences of the paper; it learns from 00 to 05."""
TESTED_360 = ("0007", "0009")
ORIGINAL_POSES = ["input.kitti_poses=kitti"]
"""The paper is tested with KITTI's own poses; those of SemanticKITTI are from another SLAM."""
_PAPER_T_ERR = (0.47, 0.39, 0.77, 0.62, 0.75)
_PAPER_R_ERR = (0.20, 0.25, 0.22, 0.23, 0.40)
PAPER: Cells = {
    sequence: {"t_err_percent": t, "r_err_deg_per_100m": r}
    for sequence, t, r in zip(TESTED, _PAPER_T_ERR, _PAPER_R_ERR, strict=True)
}
"""DeepPointMap2's row of table 1."""
_SPEED_FIGURES = {"ape_rmse_m": ".3f", "fps": ".0f"}
_APE_FIGURES = {"ape_mean_m": ".2f", "ape_rmse_m": ".2f", **SHOWN}


def _parts(request: Request, paper: Sequence[str], settings: Sequence[str] = ()) -> Sequence[Sequence[Part]]:
    sequences = present(request, paper, settings)
    own = [
        own_part(name, sequence, request, [*settings, *chosen])
        for name, chosen in registrations(request)
        for sequence in sequences
    ]
    return [[*own, *peer_parts(sequences, request, settings)]]


def _kitti_findings(request: Request, figures: Mapping[str, Figures]) -> Findings:
    sequences = present(request, TESTED, ORIGINAL_POSES)
    title = "KITTI odometry: t_err % / r_err deg per 100 m"
    over = segments(request)
    caption = f"KITTI metric of the left camera's poses, mean over {over}; mean: over the sequences. {FAILED}"
    table = ResultTable(title, [*sequences, MEAN], SHOWN, caption)
    speed = ResultTable("APE rmse m / frames per s", [*sequences, MEAN], _SPEED_FIGURES,
                        "APE: positions after SE(3) alignment; frames per second: processing alone, of each of"
                        f" {request.workers} parts at a time.")  # fmt: skip
    names = [name for name, _ in registrations(request)] + peer_names(request)
    for name in names:
        for rows in (table, speed):
            add_runs(rows, name, sequences, figures)
    table.add("DeepPointMap2", PAPER, "the paper")
    notes = paper_notes(request, sequences, TESTED)
    runs = run_folders(names, sequences, request.out)
    draw_trajectories(runs, request.out, notes)
    return Findings([table, speed], notes, runs)


def _kitti360_findings(request: Request, figures: Mapping[str, Figures]) -> Findings:
    sequences = present(request, TESTED_360)
    title = "KITTI-360: APE mean m / APE rmse m / t_err % / r_err deg per 100 m"
    caption = (
        f"APE: positions after SE(3) alignment, of the known poses. KITTI metric: over {segments(request)}. {FAILED}"
    )
    table = ResultTable(title, [*sequences, MEAN], _APE_FIGURES, caption)
    names = [name for name, _ in registrations(request)] + peer_names(request)
    for name in names:
        add_runs(table, name, sequences, figures)
    for name, ape in (("DeepPointMap2", 26.00), ("DeepPointMap", 93.77)):
        table.add(name, {"0007": {"ape_mean_m": ape}}, "the paper", "of 0009 it says: accurate")
    runs = run_folders(names, sequences, request.out)
    notes = paper_notes(replace(request, lengths=None), sequences, TESTED_360)  # its figures are positions
    draw_trajectories(runs, request.out, notes)
    return Findings([table], notes, runs)


def draw_trajectories(runs: Mapping[str, Mapping[str, Path]], out: Path, notes: list[str]) -> None:
    """The paper's figure 5: the trajectories of all methods and the truth, one image per sequence.

    Args:
        runs: folders by sequence and method.
    """
    for sequence, folders in runs.items():
        trajectories, truth = aligned_trajectories(folders)
        draw = partial(trajectories_png, trajectories=trajectories, truth=truth, title=sequence)
        if not draw_if_possible(out / f"trajectories_{sequence}.png", notes, draw):
            break  # the others would give the same note


def aligned_trajectories(folders: Mapping[str, Path]) -> tuple[dict[str, Array], Array | None]:
    """Positions (N, 3) of each run, m, in the frame of the truth, and those of the truth (M, 3)."""
    trajectories: dict[str, Array] = {}
    truth: Array | None = None
    for name, folder in folders.items():
        run = read_run(folder)
        if run.truth is not None:
            truth = run.truth.poses[:, :3, 3]
        trajectories[name] = (aligned(run) @ run.trajectory.poses)[:, :3, 3]
    return trajectories, truth


KITTI = Experiment(USES, partial(_parts, paper=TESTED, settings=ORIGINAL_POSES), _kitti_findings)
KITTI_360 = Experiment(USES, partial(_parts, paper=TESTED_360), _kitti360_findings)
