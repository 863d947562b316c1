# SPDX-License-Identifier: Apache-2.0
"""How the threads of OpenMP wait. Only the entry of a program sets this: an import changes no environment."""

from __future__ import annotations

import os


def wait_passively() -> None:
    """Let idle OpenMP threads of this process and its children sleep, unless the user has chosen otherwise.

    By default they spin while they wait for each other: on processors shared with other programs that costs 3 times the
    processor time and half the speed. OpenMP reads this once, when the first library that uses it is loaded: call it
    before numpy is imported.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # some 50 us: a sleep between two small layers takes longer than both
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")
