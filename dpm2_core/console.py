# SPDX-License-Identifier: Apache-2.0
"""Output to the terminal: text without control characters, since names and notes come from files; and progress."""

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
"""Whether notes and progress (all stderr output except errors) are left out: `--quiet` of every command."""
Advance = Callable[[int, int], None]
"""Called with the amount done and the total."""


def untold(done: int, total: int) -> None:
    """An `Advance` that does nothing."""


class Console(rich.console.Console):
    """rich's console without markup, and without control characters in the printed text."""

    def __init__(self, *, stderr: bool = False, **options: Any) -> None:
        """As rich's."""
        super().__init__(stderr=stderr, markup=False, emoji=False, quiet=stderr and QUIET.get(), **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich's; each line of a text is made printable by itself."""
        super().print(*(lines(item) if isinstance(item, str) else item for item in objects), **options)


def lines(text: str) -> str:
    """Text from files or messages, of one or several lines, made printable for a terminal."""
    return "\n".join(map(printable, text.split("\n")))


class Lines(Progress):
    """Progress without a terminal: a line after each tenth of the work, for a log."""

    def update(self, task_id: TaskID, **fields: Any) -> None:
        """As rich's."""
        before = self._tasks[task_id].percentage // 10
        super().update(task_id, **fields)
        task = self._tasks[task_id]
        if task.total and task.percentage // 10 > before:
            remaining = task.time_remaining
            suffix = f", {remaining:.0f} s left" if remaining else ""
            self.console.print(f"{task.description}: {task.completed:.0f}/{task.total:.0f}{suffix}", soft_wrap=True)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """As rich's."""
        self.update(task_id, advance=advance)


def progress_bar(console: Console | None = None) -> Progress:
    """A bar with description, count and remaining time, by default on stderr; lines if that is no terminal."""
    console = console or Console(stderr=True)
    if not console.is_terminal:
        return Lines(console=console, disable=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console)


@contextmanager
def counted(description: str) -> Iterator[Advance]:
    """A progress bar as a context; yields the function that sets the amount done and the total."""
    with progress_bar() as bar:
        task = bar.add_task(description, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def tracked(items: Iterable[_T], description: str, total: int | None = None) -> Iterator[_T]:
    """The items, with a bar that shows how many are done; `total`: their number, if `items` has no length."""
    with progress_bar() as bar:
        yield from bar.track(items, total=total, description=description)
