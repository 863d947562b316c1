# SPDX-License-Identifier: Apache-2.0
"""Packages that only some features need: the extras of the distribution `dpm2_ros` (setup.py)."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from contextlib import contextmanager

from dpm2_core.errors import UsageError

_X86_64_ONLY = ("embreex",)  # neither wheels nor sources for other Linux machines


class MissingPackageError(UsageError):
    """An extra that is not installed; the message names it."""


@contextmanager
def needs(extra: str, purpose: str) -> Iterator[None]:
    """A context around the import of a package of an extra.

    Args:
        extra: its name in setup.py. purpose: what needs the package, the subject of the message.

    Raises:
        MissingPackageError: the package is not installed, or a library of the system that it needs.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or str(error)).partition(".")[0]
        if package in _X86_64_ONLY and platform.machine() not in ("x86_64", "AMD64"):
            why = f"which does not exist for {platform.machine()}"
        else:
            why = f"which is not installed: pip install 'dpm2_ros[{extra}]'"
        raise MissingPackageError(f"{purpose} needs the package {package}, {why}") from None
    except ImportError as error:
        if "shared object file" not in str(error):
            raise
        raise MissingPackageError(f"{purpose} needs a library that this system lacks: {error}") from None
