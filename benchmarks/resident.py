# SPDX-License-Identifier: Apache-2.0
"""Memory of a process. In a module of its own, so that importing it adds little to the measured memory."""

from __future__ import annotations

from pathlib import Path

from dpm2_core.errors import Dpm2Error


def resident_mb() -> float:
    """Resident set of this process, MB.

    Raises:
        Dpm2Error: the system is not Linux.
    """
    return round(_kilobytes("VmRSS") / 1024, 1)


def peak_mb() -> int:
    """Largest resident set since the process began, MB."""
    return _kilobytes("VmHWM") // 1024


def _kilobytes(name: str) -> int:
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        raise Dpm2Error("the memory benchmark works only on Linux: it reads /proc/self/status") from None
    return next(int(line.split()[1]) for line in lines if line.startswith(name))
