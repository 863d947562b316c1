# SPDX-License-Identifier: Apache-2.0
"""Machine code is cached, and if it cannot be, this is reported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import dpm2_core

PROGRAM = """
from dpm2_core.geometry.compiled import compiled

@compiled("f8(f8)")
def twice(x):
    return 2 * x

@compiled("f8(f8)")
def thrice(x):
    return 3 * x

print(twice(1.0) + thrice(1.0))
"""


def test_without_a_folder_for_it_that_is_said_once(tmp_path: Path) -> None:
    """Previously, each start took many seconds longer without a message, for example in a read-only container."""
    program, kept = tmp_path / "program.py", tmp_path / "kept"
    program.write_text(PROGRAM)
    (tmp_path / "__pycache__").touch()  # not a folder: even root cannot write into it
    unset = {name: text for name, text in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment = unset | {"PYTHONPATH": str(Path(dpm2_core.__file__).parents[1]), "XDG_CACHE_HOME": str(program)}
    for folder, lines in (("", 1), (str(kept), 0)):
        command = [sys.executable, str(program)]
        environment = environment | {"NUMBA_CACHE_DIR": folder}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=180, check=True)
        assert done.stdout == "5.0\n"
        assert len(done.stderr.splitlines()) == lines
        assert ("NUMBA_CACHE_DIR" in done.stderr) == bool(lines)
    assert list(kept.rglob("*.nbc"))
