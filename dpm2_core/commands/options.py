# SPDX-License-Identifier: Apache-2.0
"""Shared by several commands: options, and the output of results."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import RenderableType

from dpm2_core.console import Console
from dpm2_core.errors import UsageError, exit_code
from dpm2_core.evaluation.machine import processors
from dpm2_core.files import atomic_write, json_text

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="YAML file with settings; `dpm2 config dump` prints every key.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a setting: KEY=VALUE, such as slam.map.voxel=0.3; repeat for more."),
]
InputOverrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a setting of input: KEY=VALUE, such as input.sequence=04; repeat for more."),
]
Workers = Annotated[int, typer.Option(min=1, help="Parallel workers; their number does not change the result.")]
PROCESSORS = processors()
"""Default of `Workers`."""
JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Also write the figures as JSON to a file; -: only JSON, to stdout."),
]


def show(table: RenderableType, figures: Mapping[str, Any], json_file: Path | None) -> None:
    """Print the result of a command, a table or a sentence, and write the figures as JSON if requested.

    Args:
        table: printed to stdout, except an empty text.
        json_file: `--json`; "-" prints the figures instead of the table, so that stdout contains only JSON.

    Raises:
        Dpm2Error: the file cannot be written.
    """
    text = "" if json_file is None else json_text(figures)
    if str(json_file) == "-":
        sys.stdout.write(text)
        return
    if table:
        Console().print(table, soft_wrap=isinstance(table, str))
    if json_file is not None:
        with atomic_write(json_file) as file:
            file.write(text)


def note(text: str, style: str = "") -> None:
    """Print a note for the user to stderr, apart from the results; nothing with `--quiet`."""
    Console(stderr=True).print(text, style=style, highlight=False, soft_wrap=True)


def parse_names(text: str | None) -> tuple[str, ...]:
    """`a, b` to names; None to no names."""
    return () if text is None else tuple(part.strip() for part in text.split(",") if part.strip())


def parse_lengths(text: str) -> tuple[float, ...]:
    """`10,20,30` to meters, each once, in increasing order."""
    try:
        lengths = tuple(sorted({float(part) for part in text.split(",")}))
    except ValueError:
        raise UsageError(f"--lengths {text}: want meters separated by commas, such as 10,20,30,40,50") from None
    if not all(0 < length < float("inf") for length in lengths):
        raise UsageError(f"--lengths {text}: every length must be above 0 m")
    return lengths


def run_command(command: Callable[..., int | None]) -> int:
    """Entry point of a program with one command: a function whose parameters are the options. Returns the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command)
    return exit_code(lambda: app(standalone_mode=False))
