# SPDX-License-Identifier: Apache-2.0
"""What several commands have in common: options, and the progress bar."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dpm2_core.console import Console
from dpm2_core.data.source import Span
from dpm2_core.errors import UsageError, exit_code

ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file; `dpm2 config dump` shows every key.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, such as slam.map.voxel=0.3.")]


def parse_range(text: str) -> Span:
    """`a:b`, `a:`, `:b` or `:` to (a, b or None).

    Raises:
        UsageError: it is something else.
    """
    first, colon, last = text.partition(":")
    if not colon or not all(part.isdecimal() or not part for part in (first, last)):
        raise UsageError(f"--frames {text}: want a:b, such as 0:100")
    return int(first or 0), int(last) if last else None


def run_command(command: Callable[..., int | None]) -> int:
    """Entry point of a program of one command: a function whose parameters are the options. Returns the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command)
    return exit_code(lambda: app(standalone_mode=False))


def progress_bar(console: Console | None = None) -> Progress:
    """A bar with a description, the count and the time left; on stderr by default."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console or Console(stderr=True))
