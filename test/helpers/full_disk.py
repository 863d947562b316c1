# SPDX-License-Identifier: Apache-2.0
"""Simulate a nearly full disk: files cannot grow beyond a size."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

CHECKPOINT = 1000 * 4096
"""Size of FILE-wal in bytes at which SQLite transfers it to the file by itself, and begins it anew."""


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Within the block, this process cannot write a file beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
