# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C where work must not stop in the middle; and SIGTERM, where that is as Ctrl-C."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_Handler = Callable[[int, FrameType | None], None]


def terminate_as_interrupt() -> None:
    """From here on SIGTERM is as Ctrl-C: by itself it would leave temporary files, and of a drive nothing."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


@contextmanager
def interrupt_deferred() -> Iterator[Callable[[], bool]]:
    """Inside, the first Ctrl-C raises nothing: the function that this yields returns True from then on.

    KeyboardInterrupt at any other place would leave a frame half processed, and out of compiled code it comes as
    SystemError. The second Ctrl-C raises it, for work that hangs. A handler other than Python's own stays as it is,
    and so does that of a process that ignores Ctrl-C; outside of the main thread none is ever called.
    With SIGTERM it is the same.
    """
    requested = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        requested = True
        _replace(note, signal.default_int_handler)

    with suppress(ValueError):  # not the main thread
        _replace(signal.default_int_handler, note)
    try:
        yield lambda: requested
    finally:
        _replace(note, signal.default_int_handler)


def _replace(handler: _Handler, other: _Handler) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is handler:
            signal.signal(number, other)
