# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C where work must not stop in the middle."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupt_deferred() -> Iterator[Callable[[], bool]]:
    """Inside, the first Ctrl-C raises nothing: the function that this yields returns True from then on.

    KeyboardInterrupt at any other place would leave a frame half processed, and out of compiled code it comes as
    SystemError. The second Ctrl-C raises it, for work that hangs. A handler other than Python's own stays as it is,
    and so does that of a process that ignores Ctrl-C; outside of the main thread none is ever called.
    """
    requested = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    try:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, note)
    except ValueError:  # not the main thread
        pass
    try:
        yield lambda: requested
    finally:
        if signal.getsignal(signal.SIGINT) is note:
            signal.signal(signal.SIGINT, signal.default_int_handler)
