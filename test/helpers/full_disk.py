# SPDX-License-Identifier: Apache-2.0
"""A disk that is nearly full, without a disk: files that cannot grow beyond a size."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

CHECKPOINT = 1000 * 4096
"""Bytes of FILE-wal at which SQLite by itself takes it into the file, and begins it anew."""


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """This process cannot write a file beyond `size` bytes within the block."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
