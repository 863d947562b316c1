# SPDX-License-Identifier: Apache-2.0
"""The terminal: text, whatever it looks like, since names and notes come from files; and how far a work has come."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import rich.console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from dpm2_core.errors import printable

_T = TypeVar("_T")
QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
"""Whether notes and progress, all that goes to stderr but errors, are left out: `--quiet` of every command."""
Advance = Callable[[int, int], None]
"""Told how much is done, of how much."""


def untold(done: int, total: int) -> None:
    """An `Advance` that says nothing."""


class Console(rich.console.Console):
    """rich's, without its markup, and without control characters in what is printed."""

    def __init__(self, *, stderr: bool = False, **options: Any) -> None:
        """As rich's."""
        super().__init__(stderr=stderr, markup=False, emoji=False, quiet=stderr and QUIET.get(), **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich's; in text, every line for itself."""
        super().print(*(lines(item) if isinstance(item, str) else item for item in objects), **options)


def lines(text: str) -> str:
    """Text from elsewhere for a terminal, of several lines or one."""
    return "\n".join(map(printable, text.split("\n")))


class Lines(Progress):
    """Progress where no terminal is: a line each tenth of the way, so that a log shows it."""

    def update(self, task_id: TaskID, **fields: Any) -> None:
        """As rich's."""
        before = self._tasks[task_id].percentage // 10
        super().update(task_id, **fields)
        task = self._tasks[task_id]
        if task.total and task.percentage // 10 > before:
            left = task.time_remaining
            when = f", {left:.0f} s left" if left else ""
            self.console.print(f"{task.description}: {task.completed:.0f}/{task.total:.0f}{when}", soft_wrap=True)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """As rich's."""
        self.update(task_id, advance=advance)


def progress_bar(console: Console | None = None) -> Progress:
    """A bar with a description, the count and the time left; on stderr by default. Lines where that is no terminal."""
    console = console or Console(stderr=True)
    if not console.is_terminal:
        return Lines(console=console, disable=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console)


@contextmanager
def counted(description: str) -> Iterator[Advance]:
    """A bar that is told how much is done, and how much there is to do."""
    with progress_bar() as bar:
        task = bar.add_task(description, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def tracked(items: Iterable[_T], description: str, total: int | None = None) -> Iterator[_T]:
    """The items, with a bar that says how many are done; `total`: how many there are, where they do not say it."""
    with progress_bar() as bar:
        yield from bar.track(items, total=total, description=description)
