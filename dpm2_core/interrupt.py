# SPDX-License-Identifier: Apache-2.0
"""Handling of Ctrl-C while work must not stop half-way, of SIGTERM, which acts like Ctrl-C, and of a closed terminal.

A closed terminal acts like SIGTERM or, if the process is not notified, does not stop it.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_Handler = Callable[[int, FrameType | None], None]


def terminate_as_interrupt() -> None:
    """From now on SIGTERM and a closed terminal act like Ctrl-C. The default action of SIGTERM would leave temporary
    files, and lose the results of a drive."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    hang_up_as_terminated()


def hang_up_as_terminated() -> None:
    """From now on a terminal that is closed, or whose connection breaks, acts like one SIGTERM; output written to it
    afterwards is lost. A process that ignores SIGHUP, or does not receive it (`command &`, then `exit`), continues."""
    terminals = [stream for stream in range(3) if os.isatty(stream)]  # after the hang-up isatty is False
    _survive_terminal()
    if not hasattr(signal, "SIGHUP") or signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL:
        return

    def hung_up(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # system and shell both send it: the second would end it at once
        _redirect_to_null(*terminals)
        signal.raise_signal(signal.SIGTERM)

    signal.signal(signal.SIGHUP, hung_up)


class _Terminal(io.FileIO):
    """A terminal as output; when it is gone, the output is lost without an error that would end the work."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
        _redirect_to_null(self.fileno())
        return super().write(data)


def _survive_terminal() -> None:
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or stream is not getattr(sys, f"__{name}__") or not stream.isatty():
            continue
        stream.flush()
        binary = io.BufferedWriter(_Terminal(stream.fileno(), "w", closefd=False))
        setattr(sys, name, io.TextIOWrapper(binary, stream.encoding, stream.errors, line_buffering=True))


def _redirect_to_null(*streams: int) -> None:
    null = os.open(os.devnull, os.O_RDWR)
    for stream in streams:
        os.dup2(null, stream)
    os.close(null)


_interrupt_counts: list[int] = []  # of the `interrupt_deferred` blocks that are active, the innermost last


@contextmanager
def interrupt_deferred() -> Iterator[Callable[[], bool]]:
    """Within this block the first Ctrl-C raises nothing: the function that it yields returns True from then on.

    KeyboardInterrupt at any other place would leave a frame half processed, and compiled code turns it into a
    SystemError. The second Ctrl-C raises it, for work that hangs. A handler other than Python's own is not replaced,
    nor is that of a process that ignores Ctrl-C; outside of the main thread signals are never handled.
    SIGTERM and a closed terminal are treated the same way. If blocks are nested, each counts its own first Ctrl-C.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    level = len(_interrupt_counts)
    _interrupt_counts.append(0)
    _replace_handler(signal.default_int_handler, _count_interrupt)
    try:
        yield lambda: _interrupt_counts[level] > 0
    finally:
        del _interrupt_counts[level:]
        if not _interrupt_counts:
            _replace_handler(_count_interrupt, signal.default_int_handler)


def _count_interrupt(number: int, frame: FrameType | None) -> None:
    _interrupt_counts[-1] += 1
    if _interrupt_counts[-1] > 1:
        signal.default_int_handler(number, frame)


def _replace_handler(handler: _Handler, other: _Handler) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is handler:
            signal.signal(number, other)
