# SPDX-License-Identifier: Apache-2.0
"""Worker processes for independent parts of a command's work."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.context import BaseContext

from dpm2_core.errors import Dpm2Error


@contextmanager
def worker_pool(workers: int, context: BaseContext | None = None) -> Iterator[ProcessPoolExecutor]:
    """That many worker processes. When the block ends, what no worker has begun is cancelled, and what is begun ends.

    Raises:
        Dpm2Error: a worker was killed while the block waited for it, mostly for lack of memory.
    """
    pool = ProcessPoolExecutor(workers, mp_context=context)
    try:
        yield pool
    except BrokenProcessPool:
        raise Dpm2Error(
            "a worker process was killed, perhaps because the memory was full; the same command continues, "
            "and needs less memory with fewer --workers"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)  # that of ProcessPoolExecutor would finish all of it first
