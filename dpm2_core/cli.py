# SPDX-License-Identifier: Apache-2.0
"""The `dpm2` command. Usage errors exit with 2 and one line on stderr, failures of the work with 1.

The module of a command is imported when the command is called, not to list it: numpy, gtsam and the rest take a second.
"""

from __future__ import annotations

import errno
import gc
import os
import sys
from collections.abc import Callable, Sequence
from pkgutil import resolve_name
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from dpm2_core._version import __version__
from dpm2_core.console import QUIET
from dpm2_core.errors import exit_code
from dpm2_core.imports import importing
from dpm2_core.interrupt import terminate_as_interrupt
from dpm2_core.openmp import wait_passively

GROUPS = {
    "Drives": {
        "run": ("run:run", "Run the SLAM on a recording and write trajectory, map, image, timing and metrics."),
        "eval": ("eval:eval_", "Evaluate a trajectory: KITTI metric, APE, RPE and final drift."),
        "show": (
            "show:show",
            "Draw two scans from above with their matched descriptors, colored by confidence, and how they fit.",
        ),
        "convert": ("convert:convert", "Convert a recording to a rosbag2 (MCAP) folder."),
        "sim": (
            "sim:sim",
            "Simulate a drive: scans, images, poses, point labels, scans without moving objects, "
            "and a map of the ground.",
        ),
    },
    "Maps": {
        "map": ("map:app", "Map files: info, export, merge, prune, check; pose graphs: optimize."),
    },
    "Fleets": {
        "fleet": ("fleet:app", "Many drives, on this machine or on a cluster of Ray: run, merge, sweep."),
    },
    "Learning": {
        "finetune": (
            "finetune:finetune",
            "Fine-tune the network on drives without ground truth. The trajectory of the SLAM serves as the reference.",
        ),
        "train": ("tasks:train", "Make training data and train the network."),
        "eval-task": ("tasks:eval_task", "Evaluate a trained task on scans that it was not trained on."),
    },
    "Papers": {
        "experiment": (
            "experiment:experiment",
            "Make a table or figure of the papers on your copy of the data, next to the papers' own figures.",
        ),
        "report": (
            "report:report",
            "Show runs on one page: trajectories, loops, errors by length and speed, times and states.",
        ),
    },
    "This machine": {
        "doctor": (
            "doctor:doctor",
            "Check this machine: versions, processor, GPU, memory, disk, ROS 2 and DDS; then test the SLAM for ten "
            "seconds.",
        ),
        "config": ("config:app", "Show the settings."),
        "bench": (
            "bench:bench",
            "Measure accuracy and speed compared with KISS-ICP on the same scans, memory over a long drive, or the "
            "network.",
        ),
    },
}
"""The commands as `dpm2 --help` groups them: function or Typer in `dpm2_core.commands`, MODULE:NAME, and the help."""
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}
_LAST_GROUP = "This machine"
_WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EPIPE)
"""Errors of a file that is already open, such as stdout; they name no file."""


class Commands(TyperGroup):
    """The commands of `COMMANDS`; each is imported when it is called."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        listed = {
            name: TyperCommand(name, help=text, rich_help_panel=group)
            for group, commands in GROUPS.items()
            for name, (_, text) in commands.items()
        }
        self.commands = {**listed, **self.commands}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is called, imported."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, load_command(name) if name in COMMANDS else command, rest


def load_command(name: str) -> TyperCommand | TyperGroup:
    """Import a command of `COMMANDS`; add the option `--quiet` to it and its subcommands."""
    with importing():
        found = resolve_name(f"dpm2_core.commands.{COMMANDS[name][0]}")
    command = typer.main.get_group(found) if isinstance(found, typer.Typer) else _to_command(name, found)
    for single in command.commands.values() if isinstance(command, TyperGroup) else (command,):
        single.params.extend(_to_command("quiet", _quiet_option).params)
    return command


def _to_command(name: str, function: Callable[..., Any]) -> TyperCommand:
    single = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    single.command(name)(function)
    return typer.main.get_command(single)  # type: ignore[return-value]


def _quiet_option(
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet", "-q", help="No notes and no progress: only results on stdout and errors on stderr.",
            callback=lambda value: QUIET.set(value), expose_value=False,
        ),
    ] = False,
) -> None:  # fmt: skip
    """A function with the option that all commands have."""


app = typer.Typer(
    cls=Commands,
    help="LiDAR-visual SLAM.",
    epilog="dpm2 COMMAND --help shows its options. Start with dpm2 doctor; then dpm2 run DRIVE --out out/mine.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
)


@app.callback()
def _dpm2(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), nl=False)


@app.command(rich_help_panel=_LAST_GROUP)
def version() -> None:
    """Print the version."""
    typer.echo(__version__)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    wait_passively()
    terminate_as_interrupt()
    try:
        sys.exit(_exit_status(arguments))
    finally:
        if arguments is None:  # the process ends: Python need not search all imported objects for garbage once more
            gc.freeze()


def _exit_status(arguments: Sequence[str] | None) -> int:
    args = None if arguments is None else list(arguments)
    try:
        code = exit_code(lambda: app(args=args, standalone_mode=False), "dpm2")
        if sys.stdout is not None:  # None in a service that closed it
            sys.stdout.flush()
        return code
    except typer.Abort:  # Ctrl-C that the command itself does not handle
        return 130
    except OSError as error:
        if error.errno not in _WRITE_ERRORS:
            raise
        if error.errno != errno.EPIPE:  # on EPIPE the reader, such as `head`, has what it wanted
            print(f"dpm2: output could not be written: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else the text still buffered for stdout fails again at exit
        return 1


if __name__ == "__main__":
    main()
