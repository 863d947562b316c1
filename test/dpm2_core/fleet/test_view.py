# SPDX-License-Identifier: Apache-2.0
"""What the terminal shows of a fleet."""

from __future__ import annotations

import io

from dpm2_core.console import Console
from dpm2_core.fleet.part import Outcome
from dpm2_core.fleet.view import TerminalView


def test_each_step_of_a_merge_is_counted_from_its_own_beginning() -> None:
    console = Console()
    console.file = io.StringIO()
    with TerminalView(console) as view:
        for names in (["a", "b"], ["joins/b/a"]):
            view.begun(names)
            for name in names:
                view.ended(Outcome(name, "done"))
    assert console.file.getvalue().splitlines() == ["a: done (1 of 2)", "b: done (2 of 2)", "joins/b/a: done (1 of 1)"]
