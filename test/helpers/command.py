# SPDX-License-Identifier: Apache-2.0
"""The `dpm2` command, in this process or in its own."""

from __future__ import annotations

import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from typing import NamedTuple

import pytest

from dpm2_core.cli import main


class Done(NamedTuple):
    """Exit code and what was printed."""

    returncode: int
    stdout: str
    stderr: str


def dpm2(*arguments: object) -> Done:
    """The command in this process: the same parser and exit code, without the seconds that its imports take."""
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return Done(int(end.value.code or 0), out.getvalue(), err.getvalue())


def succeeded(*arguments: object) -> Done:
    """The same, which must end well."""
    done = dpm2(*arguments)
    assert done.returncode == 0, done.stderr
    return done


def refused(*arguments: object) -> str:
    """What `dpm2` says of a request that cannot be: one line, and exit code 2."""
    done = dpm2(*arguments)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done
    assert done.stderr.startswith("dpm2: ")
    return done.stderr


def dpm2_process(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    """The command in its own process, as a shell starts it."""
    command = [sys.executable, "-m", "dpm2_core.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)  # type: ignore[call-overload]
