# SPDX-License-Identifier: Apache-2.0
"""Imports of much at once."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def importing() -> Iterator[None]:
    """Inside, Python does not look for garbage, which imports hardly make: a tenth of the time that they take.

    They make some hundred thousand objects that stay, and the search goes through all of them again and again.
    """
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()
