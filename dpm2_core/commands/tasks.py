# SPDX-License-Identifier: Apache-2.0
"""`dpm2 train TASK` and `dpm2 eval-task`: the perception tasks of the differentiable SLAM paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpm2_core.commands.options import PROCESSORS, JsonFile, Workers, note, parse_names, show
from dpm2_core.commands.train import ConfigOption, OutOption, ResumeOption, SetOption, note_training_scans, train
from dpm2_core.config import load_settings
from dpm2_core.console import progress_bar
from dpm2_core.errors import UsageError
from dpm2_core.tables import FigureTable

if TYPE_CHECKING:  # torch is slow to import
    from dpm2_core.tasks.task import TaskTraining

SourceArgument = Annotated[
    Path,
    typer.Argument(
        help="Scans: SemanticKITTI (not for dslr), a drive of `dpm2 sim`, or a folder with several; for dslr and "
        "ae_lidar also pairs of DSLR."
    ),
]


@train.command("tasks-data")
def tasks_data(
    out: Annotated[Path, typer.Argument(help="Folder to fill with train/NN and val/NN; existing drives are kept.")],
    config: ConfigOption = None,
    settings: SetOption = None,
    workers: Workers = PROCESSORS,
) -> None:
    """Simulate drives for all tasks, with exact labels and the same scans without traffic."""
    from dpm2_core.tasks.drives import TaskDriveSettings, make_task_drives

    chosen = load_settings(TaskDriveSettings, config, settings or [])
    with progress_bar() as bar:
        task = bar.add_task(f"{out}")
        make_task_drives(out, chosen, workers, lambda name, done, total: bar.update(
            task, description=f"{out}/{name}", completed=done, total=total))  # fmt: skip


SequencesOption = Annotated[
    str | None,
    typer.Option(help="Sequences of SRC, or numbers of its pairs, separated by commas, such as 00,01. Default: all."),
]
ValSequencesOption = Annotated[str | None, typer.Option(help="Sequences of --val, in the same form. Default: all.")]
ValOption = Annotated[
    Path | None, typer.Option("--val", help="Scans to evaluate on during training, in a format of SRC. Default: none.")
]


def _add(name: str, help_: str) -> None:
    """Add the command `dpm2 train NAME`, which is the same for every task."""

    def run(
        src: SourceArgument,
        config: ConfigOption = None,
        settings: SetOption = None,
        out: OutOption = Path("out") / name,
        resume: ResumeOption = False,
        val: ValOption = None,
        sequences: SequencesOption = None,
        val_sequences: ValSequencesOption = None,
    ) -> None:
        from dpm2_core.tasks.task import task_type  # torch is slow to import

        chosen = load_settings(task_type(name).training_type, config, settings or [])
        sets = (src, parse_names(sequences)), None if val is None else (val, parse_names(val_sequences))
        if val is None and val_sequences is not None:
            raise UsageError("--val-sequences: needs the folder of these sequences, --val")
        _train(name, chosen, out, resume, sets)

    command: Callable[..., None] = run
    command.__doc__ = help_
    train.command(name)(command)


_add("gndnet", "GndNet: the height of the ground around the sensor, from one scan.")
_add("dslr", "DSLR: a scan without moving objects, from a scan with them.")
_add("ae_lidar", "AE_lidar: encode a scan as a short code and decode it.")
_add("movers", "Movers: which points are on objects that move or could move. It has no SLAM loss.")


Scans = tuple[Path, Sequence[str]]
"""A folder, and the sequences in it."""


def _train(name: str, settings: TaskTraining, out: Path, resume: bool, sets: tuple[Scans, Scans | None]) -> None:
    """Train a task on the first set of scans; during training, measure it on the second, if given."""
    from dpm2_core.learning.begun import begin_or_resume, check_one_process
    from dpm2_core.learning.checkpoint import WEIGHTS
    from dpm2_core.tasks.open import open_scans, sequence_places  # torch is slow to import
    from dpm2_core.tasks.task import task_type
    from dpm2_core.tasks.training import new_task, train_task

    check_one_process(f"train {name}")
    kind = task_type(name)
    (src, sequences), val = sets
    scans = open_scans(src, kind.learns_from(settings), sequences)
    data = {"task": name, "SRC": str(src.resolve()), "sequences": list(sequences), "scans": len(scans)}
    data["content of SRC"] = content = scans.digest()
    begin_or_resume(out, resume, settings, data=data)
    validation_scans = None
    if val is not None:
        validation_scans = open_scans(val[0], kind.needs, val[1])
        places = sequence_places(*val)
        is_same_data = validation_scans.digest() == content  # such as a copy
        note_training_scans(
            f"--val {val[0]}: the task", places, places if is_same_data else sequence_places(src, sequences)
        )
    train_task(new_task(name, settings), scans, out, validation_scans)
    note(f"{out / WEIGHTS}: written")


def eval_task(
    name: Annotated[str, typer.Argument(metavar="TASK", help="gndnet, dslr, ae_lidar or movers.")],
    weights: Annotated[Path, typer.Argument(help="weights.safetensors from `dpm2 train TASK`.")],
    src: SourceArgument,
    json_file: JsonFile = None,
    picture: Annotated[Path | None, typer.Option(help="Draw one scan with its result to this PNG file.")] = None,
    frame: Annotated[
        int, typer.Option(min=0, help="Scan for --picture: its number from 0, counted over all sequences.")
    ] = 0,
    sequences: SequencesOption = None,
    slam: Annotated[
        bool, typer.Option("--slam", help="Also run the odometry on the output of the task; needs poses.")
    ] = False,
) -> None:
    """Evaluate a trained task on scans that it was not trained on."""
    from dpm2_core.tasks.open import open_scans
    from dpm2_core.tasks.task import task_type
    from dpm2_core.tasks.training import draw, load_task, measure

    needs = task_type(name).needs
    task = load_task(name, weights)
    scans = open_scans(src, needs, parse_names(sequences))
    if picture is not None:
        draw(task, scans, frame, picture)
        note(f"{picture}: written")
    figures = measure(task, scans)
    if slam:
        from dpm2_core.tasks.slam_figures import slam_figures  # imports the whole SLAM

        figures |= slam_figures(task, src, parse_names(sequences))
    table = FigureTable(f"{name}, {len(scans)} scans of {src}", names=["figure"], figures=["value"])
    for figure, value in figures.items():
        table.add_row(figure, f"{value:.4g}")
    show(table, {"task": name, "weights": str(weights), "scans": len(scans), **figures}, json_file)
