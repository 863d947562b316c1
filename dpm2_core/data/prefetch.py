# SPDX-License-Identifier: Apache-2.0
"""Reads ahead in a thread, so that disk and PNG decoder (which release the GIL) run in parallel with the algorithm."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

T = TypeVar("T")
_END = object()


def prefetch(items: Iterator[T], depth: int = 2) -> Iterator[T]:
    """The same items in the same order, up to `depth` of them read ahead, and one more being read.

    An exception of `items` is raised here, after the items before it. Closing the iterator ends the thread.
    """
    reader = ThreadPoolExecutor(1, "prefetch")
    try:
        ahead = deque(reader.submit(next, items, _END) for _ in range(depth + 2))
        while (item := ahead.popleft().result()) is not _END:
            yield cast(T, item)
            ahead.append(reader.submit(next, items, _END))
    finally:
        reader.shutdown(cancel_futures=True)
