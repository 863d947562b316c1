# SPDX-License-Identifier: Apache-2.0
"""Read ahead in a thread, so that the disk and the PNG decoder (which let go of the GIL) work beside the algorithm."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from queue import Empty, Full, Queue
from typing import TypeVar

T = TypeVar("T")
_END = object()


def prefetch(items: Iterator[T], depth: int = 2) -> Iterator[T]:
    """The same items in the same order, up to `depth` of them read before they are asked for.

    An exception of `items` is raised here, after the items before it. Closing the iterator ends the thread.
    """
    queue: Queue[object] = Queue(depth)
    stop = threading.Event()
    failure: list[BaseException] = []

    def put(item: object) -> bool:
        while not stop.is_set():
            try:
                queue.put(item, timeout=0.1)
                return True
            except Full:
                continue
        return False

    def read() -> None:
        try:
            for item in items:
                if not put(item):
                    return
        except BaseException as error:  # handed over, not swallowed
            failure.append(error)
        put(_END)

    thread = threading.Thread(target=read, name="prefetch", daemon=True)
    thread.start()
    try:
        while (item := queue.get()) is not _END:
            yield item  # type: ignore[misc]
        if failure:
            raise failure[0]
    finally:
        stop.set()
        while True:  # make room, so that a waiting put() sees the end at once
            try:
                queue.get_nowait()
            except Empty:
                break
        thread.join()
