# SPDX-License-Identifier: Apache-2.0
"""Compiles loops over points to machine code, with numba."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])
READ_F4, READ_F8 = (numba.types.Array(kind, 2, "C", readonly=True) for kind in (numba.float32, numba.float64))
"""Read-only arrays, such as the points of messages: `f4[:, ::1]` would not accept them."""


def compiled(signature: object) -> Callable[[F], F]:
    """Decorator: compile for these types when the module is imported, in double precision as written, without the GIL.

    The machine code is cached in `__pycache__` next to the source, or in the user's cache folder, so that it is made
    once per installation. If neither is writable, every start compiles again, and prints a message; `NUMBA_CACHE_DIR`
    sets another folder. A function may call only compiled functions of its own file: the cache does not detect changes
    in other files.
    """

    def decorate(function: F) -> F:
        try:
            return numba.njit(signature, cache=True, nogil=True, error_model="numpy")(function)
        except RuntimeError:  # "cannot cache function: no locator available"
            _warn_no_cache()
            return numba.njit(signature, nogil=True, error_model="numpy")(function)

    return decorate


@functools.cache  # once
def _warn_no_cache() -> None:
    text = "no folder for machine code can be written, so every start compiles it anew: let NUMBA_CACHE_DIR name one"
    print(f"dpm2: {text}", file=sys.stderr)
