# SPDX-License-Identifier: Apache-2.0
"""Tables 1 to 4 of "Differentiable SLAM Helps Deep Learning-based LiDAR Perception Tasks" (BMVC 2023): every task
trained without and with the SLAM loss, and with a placebo of it, from the same first epochs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from statistics import mean
from typing import Any

from dpm2_core.errors import UsageError
from dpm2_core.experiments.kitti import draw_trajectories
from dpm2_core.experiments.paired import paired_gain
from dpm2_core.experiments.request import Experiment, Findings, Request
from dpm2_core.experiments.sequences import learned_note
from dpm2_core.experiments.table import Cells, ResultTable
from dpm2_core.experiments.task_part import (
    MEASURE,
    SLAM,
    TRAIN,
    Arm,
    Training,
    first_slam_epoch,
    folder_name,
    settings_of,
)
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.learning.checkpoint import CHECKPOINT, WEIGHTS
from dpm2_core.tasks.open import open_scans, sequence_names

SEEDS = 3
ARMS: tuple[Arm, ...] = ("without", "with", "placebo")
COMPARED: Mapping[str, tuple[Arm, Arm]] = {
    "with": ("without", "with"), "placebo": ("without", "placebo"), "with_over_placebo": ("placebo", "with"),
}  # fmt: skip
"""Compared arms by the name of their gain. Only the last is the gain of the loss itself; the intervals of the other two
do not show it."""
ROWS = {"without": "without SLAM loss", "with": "with SLAM loss", "placebo": "with that of another window"}


@dataclass(frozen=True)
class TaskTable:
    """A table of the paper.

    Attributes:
        task: in `tasks.task.TASKS`. measured: `MEASURE` or `SLAM`.
        figures: of the task, and how they are printed; for those in `higher`, higher is better.
        paper: rows of the paper by name.
        learn, test: sequences or pairs of the paper. defaults: settings of the training, which the user's replace.
        notes: differences from the paper.
    """

    title: str
    task: str
    measured: str
    figures: Mapping[str, str]
    paper: Mapping[str, Mapping[str, float]]
    learn: Sequence[str]
    test: Sequence[str]
    defaults: Sequence[str]
    higher: frozenset[str] = frozenset()
    notes: Sequence[str] = ()

    def experiment(self) -> Experiment:
        """The experiment for the registry."""
        return Experiment(frozenset({"learn", "seeds", "config"}), self.parts, self.findings)

    def parts(self, request: Request) -> Sequence[Sequence[Part]]:
        """First epochs that the arms of a seed share, the arms, and their measurement.

        Raises:
            UsageError: the SLAM loss would never be used, or there are no such scans.
        """
        self._check_slam_loss(request)
        learned_digest, tested_digest = (
            open_scans(request.data, (), words).digest() for words in self._sequences(request)
        )
        shared: list[Part] = []
        arms: list[Part] = []
        measured: list[Part] = []
        drive = request.data, list(self._sequences(request)[1])
        for seed in range(request.seeds or SEEDS):
            shared_epochs = first_slam_epoch(settings_of(self._training(request, seed, "with")))
            start = None
            if shared_epochs:
                training = self._training(request, seed, "without")
                shared.append(Part(self._arm_name(seed, "shared"), TRAIN,
                                   {"training": training, "until": shared_epochs},
                                   request.config_files, content=learned_digest))  # fmt: skip
                start = request.out / self._arm_name(seed, "shared")
            for arm in ARMS:
                name = self._arm_name(seed, arm)
                training = self._training(request, seed, arm)
                checkpoint = [] if start is None else [start / CHECKPOINT]
                inputs = [*request.config_files, *checkpoint]
                arms.append(Part(name, TRAIN, {"training": training, "start": start}, inputs, content=learned_digest))
                weights = request.out / name / WEIGHTS
                arguments = {"task": self.task, "weights": weights, "drive": drive}
                part = Part(
                    self._measurement_name(seed, arm), self.measured, arguments, [weights], content=tested_digest
                )
                measured.append(part)
        return [stage for stage in (shared, arms, measured) if stage]

    def _check_slam_loss(self, request: Request) -> None:
        """Require that the SLAM loss is used: otherwise all arms would be the same, and the gain exactly zero."""
        settings = settings_of(self._training(request, 0, "with"))
        if settings.slam.gamma == 0 or not any(map(settings.has_windows, range(settings.epochs))):
            slam = settings.slam
            raise UsageError(
                f"{self.task}: the training never uses the SLAM loss, which is compared: slam.gamma is {slam.gamma:g},"
                f" slam.begin {slam.begin}, slam.every {slam.every}, in {settings.epochs} epochs; set them in the file"
                " of --config, which replaces the experiment's own values"
            )

    def findings(self, request: Request, figures: Mapping[str, Figures]) -> Findings:
        """The table, with a row per arm, and the gain by the SLAM loss."""
        seeds = range(request.seeds or SEEDS)
        table = ResultTable(self.title, list(self.figures), {"mean": ".4g"}, "Means over the seeds and the test scans.")
        values_by_arm: dict[str, dict[str, list[float]]] = {
            arm: {name: [figures[self._measurement_name(seed, arm)][name] for seed in seeds] for name in self.figures}
            for arm in ARMS
        }
        for arm in ARMS:
            table.add(ROWS[arm], _means(values_by_arm[arm]))
        for name, row in self.paper.items():
            table.add(name, {figure: {"mean": value} for figure, value in row.items()}, "the paper")
        gains: dict[str, dict[str, Any]] = {}
        gain_table = ResultTable("Gain, and its 95 % interval", ["gain"], {"percent": "+.1f"},
                                 "Over the mean of the arm named last, seed by seed; positive is better.")  # fmt: skip
        for key, (before, arm) in COMPARED.items():
            for figure in self.figures:
                gain = paired_gain(values_by_arm[before][figure], values_by_arm[arm][figure], figure not in self.higher)
                if gain is not None:
                    gains.setdefault(key, {})[figure] = asdict(gain)
                    compared = f"{figure}: {ROWS[arm]} for {ROWS[before]}"
                    gain_table.add(compared, {"gain": {"percent": 100 * gain.mean}}, note=str(gain))
        notes = [*self.notes, *self._warnings(request, values_by_arm, figures)]
        if self.measured == SLAM:
            self._draw_trajectories(request, figures, notes)
        return Findings([table, gain_table], notes, extra={"gains": gains})

    def _warnings(
        self, request: Request, values_by_arm: Mapping[str, Mapping[str, list[float]]], figures: Mapping[str, Figures]
    ) -> list[str]:
        notes = learned_note(*(sequence_names(request.data, chosen) for chosen in self._sequences(request)))
        settings = settings_of(self._training(request, 0, "with"))
        if settings.has_windows(settings.epochs - 1):
            notes.append(
                "the last epoch uses the SLAM loss, and the arms are measured right after it; choose another slam.every"
            )
        still_rpe = [
            figures[self._measurement_name(seed, "without")].get("still_rpe_m")
            for seed in range(request.seeds or SEEDS)
        ]
        if self.measured == SLAM and still_rpe[0] is not None and sum(values_by_arm["without"]["output_rpe_m"]) >= sum(
            value for value in still_rpe if value is not None
        ):  # fmt: skip
            notes.append("odometry on the network's output is no better than standing still: nothing can be compared")
        return notes

    def _draw_trajectories(self, request: Request, figures: Mapping[str, Figures], notes: list[str]) -> None:
        """The paper's figure 3: trajectories on the output of both arms of the first seed, one image per sequence."""
        names = map(folder_name, figures[self._measurement_name(0, "with")]["sequences"])
        folders = {ROWS[arm]: request.out / self._measurement_name(0, arm) for arm in ("without", "with")}
        runs = {name: {row: folder / name / "output" for row, folder in folders.items()} for name in names}
        draw_trajectories(runs, request.out, notes)

    def _training(self, request: Request, seed: int, arm: Arm) -> Training:
        defaults = () if request.config is not None else self.defaults
        return Training(
            task=self.task, data=request.data, learn=list(self._sequences(request)[0]), config=request.config,
            settings=[*defaults, *request.overrides], seed=seed, arm=arm,
        )  # fmt: skip

    def _sequences(self, request: Request) -> tuple[Sequence[str], Sequence[str]]:
        """The sequences to learn from, and those to test on."""
        return request.learn or self.learn, request.sequences or self.test

    def _arm_name(self, seed: int, arm: str) -> str:
        return f"{self.task}/seed_{seed}/{arm}"

    def _measurement_name(self, seed: int, arm: str) -> str:
        kind = "slam" if self.measured == SLAM else "figures"
        return f"{self._arm_name(seed, arm)}/{kind}"


def _means(figures: Mapping[str, Sequence[float]]) -> Cells:
    finite = {name: [value for value in values if isfinite(value)] for name, values in figures.items()}
    return {name: {"mean": mean(values) if values else None} for name, values in finite.items()}


_CARLA_LEARN, _CARLA_TEST = tuple(map(str, range(8))), tuple(map(str, range(9, 15)))
_PAPER_GROUND = {
    "mse_authors": (0.76, 0.72), "ground_iou": (0.81, 0.81), "ground_precision": (0.85, 0.83),
    "ground_recall": (0.94, 0.97),
}  # fmt: skip
_OBSTACLE_FIGURES = ("mse", "miou", "precision", "recall")
_DSLR_DEFAULTS = ("slam.gamma=8", "slam.begin=44", "slam.every=3", "slam_loss.points=1024")

GNDNET = TaskTable(
    title="Table 1: GndNet on SemanticKITTI",
    task="gndnet",
    measured=MEASURE,
    figures=dict.fromkeys((*_PAPER_GROUND, *_OBSTACLE_FIGURES), ".4g"),
    paper={
        "GndNet": {name: both[0] for name, both in _PAPER_GROUND.items()},
        "GndNet with SLAM loss": {name: both[1] for name, both in _PAPER_GROUND.items()},
    },
    learn=("00", "02", "03", "04", "08", "10"),
    test=("05", "09", "01", "06"),
    defaults=("slam.gamma=1", "slam.begin=1", "slam.every=3", "slam_loss.points=4096"),
    higher=frozenset({"ground_iou", "ground_precision", "ground_recall", "miou", "precision", "recall"}),
    notes=(
        "the paper's figures are of the ground: ground_... and mse_authors; precision and recall are of obstacles",
        "its 6,554 test frames are those of 05, 09 and two of 01, 06, 07; the paper does not state which two",
    ),
)
DSLR = TaskTable(
    title="Table 2: DSLR, Chamfer distance to the static twin",
    task="dslr",
    measured=MEASURE,
    figures=dict.fromkeys(("chamfer", "chamfer_m", "moved_m"), ".4g"),
    paper={
        "DSLR, CARLA-64": {"chamfer": 7.85}, "DSLR with SLAM loss, CARLA-64": {"chamfer": 6.96},
        "DSLR, ARD-16": {"chamfer": 0.34}, "DSLR with SLAM loss, ARD-16": {"chamfer": 0.31},
    },
    learn=_CARLA_LEARN,
    test=_CARLA_TEST,
    defaults=_DSLR_DEFAULTS,
    notes=("the paper's row of KITTI 08 needs DSLR-UDA, which learns without twins and is not part of dpm2",),
)  # fmt: skip
DSLR_SLAM = replace(
    DSLR,
    title="Table 3: odometry on what DSLR makes",
    measured=SLAM,
    figures=dict.fromkeys(("output_ate_m", "output_rpe_m", "output_rpe_deg", "kept_ate_m", "kept_rpe_m"), ".4g"),
    paper={
        f"DSLR{arm}, {data}": {"output_ate_m": ate}
        for data, both in {
            "CARLA-64 0": (4.73, 2.37), "CARLA-64 1": (2.9, 1.3), "CARLA-64 2": (1.36, 0.76),
            "CARLA-64 3": (4.4, 4.09), "ARD-16 3": (2.05, 1.94),
        }.items()
        for arm, ate in zip(("", " with SLAM loss"), both, strict=True)
    },
    notes=(
        "the paper's 0 to 3 are drives recorded for this table; tested are the pairs of Table 2, or --sequences",
        "true poses are read from posesN.txt next to the pairs, or from the drive",
    ),
)  # fmt: skip
AE_LIDAR = TaskTable(
    title="Table 4: AE_lidar, Chamfer distance of the reconstruction",
    task="ae_lidar",
    measured=MEASURE,
    figures=dict.fromkeys(("chamfer", "chamfer_m", "d_error_m"), ".4g"),
    paper={"AE_lidar, CARLA-64": {"chamfer": 3.03}, "AE_lidar with SLAM loss, CARLA-64": {"chamfer": 2.83}},
    learn=_CARLA_LEARN,
    test=_CARLA_TEST,
    defaults=("slam.gamma=30", "slam.begin=29", "slam.every=3", "slam_loss.points=1024"),
)
AE_LIDAR_SLAM = replace(
    AE_LIDAR,
    title="Odometry on what AE_lidar makes",
    measured=SLAM,
    figures=dict.fromkeys(("output_ate_m", "output_rpe_m", "output_rpe_deg"), ".4g"),
    paper={},
    notes=("the paper has no such table; it shows what the SLAM loss is meant to improve",),
)
gndnet, dslr, dslr_slam, ae_lidar, ae_lidar_slam = (
    table.experiment() for table in (GNDNET, DSLR, DSLR_SLAM, AE_LIDAR, AE_LIDAR_SLAM)
)
