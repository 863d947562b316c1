# SPDX-License-Identifier: Apache-2.0
"""What several commands have in common: options, and the progress bar."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dpm2_core.console import Console
from dpm2_core.errors import UsageError

ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file; `dpm2 config dump` shows every key.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, such as slam.map.voxel=0.3.")]


def parse_range(text: str) -> tuple[int, int | None]:
    """`a:b`, `a:`, `:b` or `:` to (a, b or None).

    Raises:
        UsageError: it is something else.
    """
    first, colon, last = text.partition(":")
    if not colon or not all(part.isdecimal() or not part for part in (first, last)):
        raise UsageError(f"--frames {text}: want a:b, such as 0:100")
    return int(first or 0), int(last) if last else None


def progress_bar(console: Console | None = None) -> Progress:
    """A bar with a description, the count and the time left; on stderr unless told otherwise."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console or Console(stderr=True))
