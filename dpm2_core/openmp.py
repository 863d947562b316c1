# SPDX-License-Identifier: Apache-2.0
"""Number of OpenMP threads and how idle ones wait. Only the entry point of a program sets this, never an import."""

from __future__ import annotations

import os


def wait_passively() -> None:
    """Let idle threads of this process and its children sleep, unless the user has chosen otherwise.

    By default they spin while they wait for each other: on processors shared with other programs that costs 3 times the
    processor time and half the speed. The threads of OpenBLAS (numpy) spin as well, and the products here are too small
    to be parallelized: OpenBLAS gets one thread. Both libraries read this when they are loaded: call it before the
    import of numpy.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # some 50 us: a sleep between two small layers takes longer than both
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def allowed(threads: int) -> int:
    """`threads`, limited to OMP_THREAD_LIMIT.

    torch assumes that it gets all the threads that it requested; it leaves the parts of its results that the missing
    threads should compute unwritten.
    """
    limit = os.environ.get("OMP_THREAD_LIMIT", "")
    return min(threads, int(limit)) if limit.isdecimal() and int(limit) > 0 else threads
