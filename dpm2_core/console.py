# SPDX-License-Identifier: Apache-2.0
"""The terminal. What is printed is text, whatever it looks like: names and notes come from files."""

from __future__ import annotations

from contextvars import ContextVar
from typing import Any

import rich.console

from dpm2_core.errors import printable

QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
"""Whether notes and progress, all that goes to stderr but errors, are left out: `--quiet` of every command."""


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
