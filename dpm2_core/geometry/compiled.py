# SPDX-License-Identifier: Apache-2.0
"""Loops over points as machine code, by numba."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])
READ_F4, READ_F8 = (numba.types.Array(kind, 2, "C", readonly=True) for kind in (numba.float32, numba.float64))
"""Arrays that may not be written to, as the points of messages are: `f4[:, ::1]` would not take them."""


def compiled(signature: object) -> Callable[[F], F]:
    """Decorator: compile for these types when the module is imported, in double precision as written, without the GIL.

    The machine code is kept in `__pycache__` beside the source, or in the user's cache folder, so that it is made once
    after an installation. Where neither can be written, every start compiles anew, and says so; `NUMBA_CACHE_DIR`
    names another folder. A function may call compiled ones of its own file alone: the cache does not see that another
    file changed.
    """

    def decorate(function: F) -> F:
        try:
            return numba.njit(signature, cache=True, nogil=True, error_model="numpy")(function)
        except RuntimeError:  # "cannot cache function: no locator available"
            _say_that_it_takes_time()
            return numba.njit(signature, nogil=True, error_model="numpy")(function)

    return decorate


@functools.cache  # once
def _say_that_it_takes_time() -> None:
    text = "no folder for machine code can be written, so every start compiles it anew: let NUMBA_CACHE_DIR name one"
    print(f"dpm2: {text}", file=sys.stderr)
