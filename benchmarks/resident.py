# SPDX-License-Identifier: Apache-2.0
"""What a process has in memory. Apart: what is measured should not be what was imported to measure it."""

from __future__ import annotations

import os
from pathlib import Path

from dpm2_core.errors import Dpm2Error


def resident_mb() -> float:
    """Resident set of this process, MB.

    Raises:
        Dpm2Error: the system is not Linux.
    """
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        raise Dpm2Error("the memory benchmark reads /proc/self/statm, which only Linux has") from None
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)
