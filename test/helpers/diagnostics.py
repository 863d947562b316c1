# SPDX-License-Identifier: Apache-2.0
"""Conditions that a test waits for in /diagnostics."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticStatus


def figures(status: DiagnosticStatus) -> dict[str, str]:
    """Values of a status by their keys."""
    return {value.key: value.value for value in status.values}


def having(**expected: object) -> Callable[[DiagnosticStatus], bool]:
    """Condition: the status has these values."""
    wanted = {key: str(value) for key, value in expected.items()}
    return lambda status: wanted.items() <= figures(status).items()


def saying(text: str) -> Callable[[DiagnosticStatus], bool]:
    """Condition: the message of the status contains `text`."""
    return lambda status: text in status.message
