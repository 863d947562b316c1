# SPDX-License-Identifier: Apache-2.0
"""The first Ctrl-C waits for the end of a step, the second does not; whoever handles it otherwise keeps doing so."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator

import pytest

from dpm2_core.interrupt import interrupt_deferred, terminate_as_interrupt


@pytest.fixture(autouse=True)
def python_handles_it() -> Iterator[None]:
    """A test in the background may have it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_the_first_waits_and_the_second_raises() -> None:
    with interrupt_deferred() as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGINT)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_within_another_one_each_takes_its_own() -> None:
    """The one that ends the drive does not count for what is written then."""
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
    before = signal.getsignal(signal.SIGTERM)
    try:
        terminate_as_interrupt()
        with interrupt_deferred() as interrupted:
            signal.raise_signal(signal.SIGTERM)
            assert interrupted()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


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
