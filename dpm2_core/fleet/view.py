# SPDX-License-Identifier: Apache-2.0
"""A fleet on the terminal: one table with the progress of each drive; plain lines without a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from dpm2_core.console import Console
from dpm2_core.fleet.cluster import Status
from dpm2_core.fleet.part import Outcome
from dpm2_core.fleet.run import View

_MAX_ROWS = 30
"""Running drives that are shown at once."""


class TerminalView(View):
    """A context manager; the table of running drives disappears when it is left."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, transient=True, refresh_per_second=2)
        self._names: list[str] = []
        self._status: Mapping[str, Status] = {}
        self._ended: dict[str, Outcome] = {}

    def __enter__(self) -> TerminalView:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def begun(self, names: Sequence[str]) -> None:
        """As `View`."""
        self._names, self._ended = list(names), {}  # a merge begins several times

    def running(self, status: Mapping[str, Status]) -> None:
        """As `View`."""
        self._status = status
        if self._console.is_terminal:
            self._live.update(self._running_table())

    def ended(self, outcome: Outcome) -> None:
        """As `View`."""
        self._ended[outcome.name] = outcome
        count = f"{len(self._ended)} of {len(self._names)}"
        text = f"failed: {outcome.reason}" if outcome.reason else "done"
        self._console.print(f"{outcome.name}: {text} ({count})", style="red" if outcome.reason else "", soft_wrap=True)

    def _running_table(self) -> Group:
        table = Table(box=None, header_style="dim")
        for heading in ("drive", "", "frames", "attempt", "worker"):
            table.add_column(heading, no_wrap=True)
        running = [name for name in self._names if name in self._status and name not in self._ended]
        for name in running[:_MAX_ROWS]:
            status = self._status[name]
            bar = ProgressBar(total=status.total or None, completed=status.done, width=24)
            count = f"{status.done}/{status.total}" if status.total else "begins"
            table.add_row(Text(name), bar, count, str(status.attempts), Text(status.where))
        failed = sum(bool(outcome.reason) for outcome in self._ended.values())
        waiting = len(self._names) - len(running) - len(self._ended)
        summary = f"{len(running)} run, {waiting} wait, {len(self._ended)} ended, {failed} of them failed"
        return Group(table, Text(summary))
