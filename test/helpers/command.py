# SPDX-License-Identifier: Apache-2.0
"""The `dpm2` command, in this process or in its own."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from typing import NamedTuple

import pytest

from dpm2_core.cli import main


class Done(NamedTuple):
    """Exit code and output."""

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
    """Run the command, which must succeed."""
    done = dpm2(*arguments)
    assert done.returncode == 0, done.stderr
    return done


def refused(*arguments: object) -> str:
    """Error message of `dpm2` for an invalid request: one line, with exit code 2."""
    done = dpm2(*arguments)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done
    assert done.stderr.startswith("dpm2: ")
    return done.stderr


def dpm2_process(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    """The command in its own process, as a shell starts it."""
    return subprocess.run(_command(arguments), capture_output=True, text=True, timeout=120, **options)  # type: ignore[call-overload]


@contextmanager
def started(*arguments: object, until: Callable[[], object] = lambda: True) -> Iterator[subprocess.Popen[str]]:
    """Start the command in its own process and wait for `until`, for example to interrupt it. It is killed at the end
    of the block."""
    listen = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # it is ignored if the tests run in the background
    with subprocess.Popen(_command(arguments), stderr=subprocess.PIPE, text=True, preexec_fn=listen) as process:
        try:
            while not until():
                assert process.poll() is None
                time.sleep(0.05)
            assert process.poll() is None
            yield process
        finally:
            process.kill()


def _command(arguments: tuple[object, ...]) -> list[str]:
    return [sys.executable, "-m", "dpm2_core.cli", *map(str, arguments)]
