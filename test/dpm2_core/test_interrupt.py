# SPDX-License-Identifier: Apache-2.0
"""The first Ctrl-C waits for the end of a step, the second does not; other handlers of a program are kept."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from dpm2_core.interrupt import interrupt_deferred, terminate_as_interrupt


@pytest.fixture(autouse=True)
def python_handles_it() -> Iterator[None]:
    """In a test run in the background, the signal may be ignored."""
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for name, handler in before.items():
        signal.signal(name, handler)


def test_the_first_waits_and_the_second_raises() -> None:
    with interrupt_deferred() as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGINT)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_within_another_one_each_takes_its_own() -> None:
    """The Ctrl-C that ends the drive does not count while its results are written."""
    with interrupt_deferred() as written:
        with interrupt_deferred() as driven:
            signal.raise_signal(signal.SIGINT)
            assert driven()
        assert not written()
        signal.raise_signal(signal.SIGINT)
        assert written()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_sigterm_is_as_ctrl_c() -> None:
    terminate_as_interrupt()
    with interrupt_deferred() as interrupted:
        signal.raise_signal(signal.SIGTERM)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


HUNG_UP = """
import signal, sys, time
from pathlib import Path
from dpm2_core.interrupt import interrupt_deferred, terminate_as_interrupt
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
signal.alarm(60)
terminate_as_interrupt()
with interrupt_deferred() as interrupted:
    print("begun", flush=True)
    while not interrupted():
        time.sleep(0.01)
    for stream in (sys.stdout, sys.stderr):
        print("nobody reads this", file=stream, flush=True)
    while not Path("again").exists():
        time.sleep(0.01)
    Path("results").touch()
"""


def test_a_terminal_that_is_closed_is_as_one_ctrl_c(tmp_path: Path) -> None:
    """Closing the terminal acts as one Ctrl-C; the shell's second signal does not count as a second one. Unhandled, the
    signal would end the drive without results, and later writes to the terminal are errors."""
    screen, terminal = os.openpty()
    attach = partial(fcntl.ioctl, terminal, termios.TIOCSCTTY, 0)
    with subprocess.Popen(
        [sys.executable, "-c", HUNG_UP], cwd=tmp_path, stdin=terminal, stdout=terminal, stderr=terminal,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, start_new_session=True, preexec_fn=attach,
    ) as process:  # fmt: skip
        os.close(terminal)
        assert os.read(screen, 100).strip() == b"begun"
        os.close(screen)
        process.send_signal(signal.SIGHUP)
        (tmp_path / "again").touch()
        assert process.wait(60) == 0
    assert (tmp_path / "results").exists()


OUTLIVES = """
import sys, time
from pathlib import Path
from dpm2_core.console import Console, tracked
from dpm2_core.interrupt import terminate_as_interrupt
terminate_as_interrupt()
Console(stderr=True).print("begun")
while not Path("closed").exists():
    time.sleep(0.01)
for stream in (sys.stdout, sys.stderr):
    print("nobody reads this", file=stream, flush=True)
Console().print("nor this")
list(tracked(range(3), "scans"))
Path("results").touch()
"""


def test_a_program_that_is_not_told_goes_on_without_its_terminal(tmp_path: Path) -> None:
    """A background program whose shell was left by `exit` continues. Previously, a write to the closed terminal was an
    error, which ended a drive with code 1 and without results."""
    screen, terminal = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", OUTLIVES], cwd=tmp_path, stdin=terminal, stdout=terminal, stderr=terminal,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, start_new_session=True,
    ) as process:  # fmt: skip
        os.close(terminal)
        assert os.read(screen, 100).strip() == b"begun"
        os.close(screen)
        (tmp_path / "closed").touch()
        assert process.wait(60) == 0
    assert (tmp_path / "results").exists()


def test_under_nohup_a_terminal_that_is_closed_ends_nothing() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    terminate_as_interrupt()
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.parametrize("fails", [False, True])
def test_afterwards_it_raises_as_before(fails: bool) -> None:
    try:
        with interrupt_deferred():
            if fails:
                raise OSError
    except OSError:
        pass
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_a_handler_of_the_application_is_called() -> None:
    seen: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    with interrupt_deferred() as interrupted:
        signal.raise_signal(signal.SIGINT)
        assert not interrupted()
    assert seen == [signal.SIGINT]


def test_an_ignored_one_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupt_deferred() as interrupted:
        signal.raise_signal(signal.SIGINT)
        assert not interrupted()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_in_another_thread_nothing_changes() -> None:
    seen: list[bool] = []

    def work() -> None:
        with interrupt_deferred() as interrupted:
            seen.append(interrupted())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
