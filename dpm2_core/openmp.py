# SPDX-License-Identifier: Apache-2.0
"""How many threads OpenMP may have, and how idle ones wait. Only the entry of a program sets it, no import."""

from __future__ import annotations

import os


def wait_passively() -> None:
    """Let idle threads of this process and its children sleep, unless the user has chosen otherwise.

    By default they spin while they wait for each other: on processors shared with other programs that costs 3 times the
    processor time and half the speed. Those of OpenBLAS, numpy's, spin as well, and the products here are too small to
    be shared: it gets one. Both libraries read this once, when they are loaded: call it before numpy is imported.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # some 50 us: a sleep between two small layers takes longer than both
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def allowed(threads: int) -> int:
    """So many threads, or as many as OMP_THREAD_LIMIT allows.

    torch believes that it gets as many as it was told, and leaves the parts of the others of its results unwritten.
    """
    limit = os.environ.get("OMP_THREAD_LIMIT", "")
    return min(threads, int(limit)) if limit.isdecimal() and int(limit) > 0 else threads
