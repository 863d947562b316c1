# SPDX-License-Identifier: Apache-2.0
"""The `dpm2` command. Errors of use exit with 2 and one line on stderr, failures of the work with 1.

A command's module is imported when it is called, not to list it: numpy, gtsam and the rest take a second.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from dpm2_core._version import __version__
from dpm2_core.errors import exit_code
from dpm2_core.openmp import wait_passively

COMMANDS = {
    "run": ("run:run", "Run the SLAM on a recording and write trajectory, map, image, timing and metrics."),
    "eval": ("eval:eval_", "Evaluate a trajectory: KITTI metric, APE, RPE and final drift."),
    "show": (
        "show:show",
        "Draw two scans from above with their matched descriptors, colored by confidence, and how they fit.",
    ),
    "sim": (
        "sim:sim",
        "Simulate a drive: scans, images, poses, point labels, scans without moving objects, and a map of the ground.",
    ),
    "bench": (
        "bench:bench",
        "Measure accuracy and speed beside KISS-ICP on the same scans, memory over a long drive, or the network.",
    ),
    "finetune": (
        "finetune:finetune",
        "Fine-tune the network on drives without ground truth: the reference is the trajectory of the SLAM.",
    ),
    "eval-task": ("tasks:eval_task", "Measure a trained task on scans that it has not learned from."),
    "convert": ("convert:app", "Convert a recording to a rosbag2 (MCAP) folder."),
    "config": ("config:app", "Look at the configuration."),
    "map": ("map:app", "Map files: info, export, merge, prune, check; pose graphs: optimize."),
    "train": ("tasks:train", "Make training data and train the network."),
}
"""Each command: its function or Typer in `dpm2_core.commands`, MODULE:NAME, and what `dpm2 --help` says of it."""


class Commands(TyperGroup):
    """The commands of `COMMANDS`; each is imported once it is called."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        listed = {name: TyperCommand(name, help=text) for name, (_, text) in COMMANDS.items()}
        self.commands = {**listed, **self.commands}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is called, imported."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, load_command(name) if name in COMMANDS else command, rest


def load_command(name: str) -> TyperCommand | TyperGroup:
    """Import a command of `COMMANDS`."""
    module, attribute = COMMANDS[name][0].split(":")
    found = getattr(import_module(f"dpm2_core.commands.{module}"), attribute)
    if isinstance(found, typer.Typer):
        return typer.main.get_group(found)
    single = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    single.command(name)(found)
    return typer.main.get_command(single)  # type: ignore[return-value]


app = typer.Typer(
    cls=Commands, help="LiDAR-visual SLAM.", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)


@app.callback()
def _dpm2() -> None:
    pass


@app.command()
def version() -> None:
    """Print the version."""
    typer.echo(__version__)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    wait_passively()
    sys.exit(_status(arguments))


def _status(arguments: Sequence[str] | None) -> int:
    args = None if arguments is None else list(arguments)
    return exit_code(lambda: app(args=args, standalone_mode=False), "dpm2")


if __name__ == "__main__":
    main()
