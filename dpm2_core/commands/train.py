# SPDX-License-Identifier: Apache-2.0
"""`dpm2 train`: make training data, train registration (phase1) and overlap (phase2)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dpm2_core.config import load_settings
from dpm2_core.errors import UsageError

train = typer.Typer(help="Make training data and train the network.", no_args_is_help=True)

ConfigOption = Annotated[Path | None, typer.Option("--config", help="YAML; its defaults otherwise.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, such as optimiser.steps=2000.")]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for checkpoint, log and weights.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Continue from the checkpoint in --out.")]


@train.command()
def data(
    out: Annotated[Path, typer.Argument(help="Folder to fill; worlds that are there already stay.")],
    config: ConfigOption = None,
    settings: SetOption = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
) -> None:
    """Scans of many synthetic worlds, packed for training."""
    from dpm2_core.training.generate import GenerateSettings, generate  # torch and embree are slow to import

    chosen = load_settings(GenerateSettings, config, settings or [])
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as bar:
        task = bar.add_task(f"worlds -> {out}", total=chosen.worlds)
        generate(out, chosen, workers, lambda done, total: bar.update(task, completed=done, total=total))


@train.command()
def phase1(
    config: ConfigOption = None,
    settings: SetOption = None,
    out: OutOption = Path("out/phase1"),
    resume: ResumeOption = False,
) -> None:
    """Registration: encoder, decoder, similarity and offset heads."""
    from dpm2_core.training.phase_one import PhaseOneSettings, phase_one

    _refuse_overwriting(out, resume)
    phase_one(load_settings(PhaseOneSettings, config, settings or []), out, resume)


@train.command()
def phase2(
    config: ConfigOption = None,
    settings: SetOption = None,
    out: OutOption = Path("out/phase2"),
    resume: ResumeOption = False,
) -> None:
    """Overlap head alone, on the network of phase one."""
    from dpm2_core.training.phase_two import PhaseTwoSettings, phase_two

    _refuse_overwriting(out, resume)
    phase_two(load_settings(PhaseTwoSettings, config, settings or []), out, resume)


def _refuse_overwriting(out: Path, resume: bool) -> None:
    if (out / "checkpoint.pt").exists() and not resume:
        raise UsageError(f"{out}: holds a training; --resume continues it, another --out keeps it")
    if resume and not (out / "checkpoint.pt").exists():
        raise UsageError(f"{out}: no checkpoint.pt to resume")
