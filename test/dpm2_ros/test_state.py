# SPDX-License-Identifier: Apache-2.0
"""The log reports a state that the user must know of once, with the reason."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rclpy.logging import LoggingSeverity
from std_msgs.msg import String

from dpm2_core.estimates import OdometryResult, Registration, State
from dpm2_ros.state import StatePublisher
from dpm2_ros.subscriptions import LAST_ONE


def result(state: State, reason: str, breaks: int = 0) -> OdometryResult:
    registration = Registration(np.eye(4), np.eye(6), 0.5, 1.0, "geometric", state is State.TRACKING, reason)
    return OdometryResult(0, 0, np.eye(4), np.eye(6), np.zeros(6), state, registration, breaks=breaks)


@pytest.mark.usefixtures("no_earlier_nodes")
def test_lost_and_broken_are_logged_once_with_the_reason(ros: Callable[..., Any]) -> None:
    harness = ros()
    log, states = harness.hear(Log, "/rosout"), harness.hear(String, "/dpm2/state", LAST_ONE)
    harness.wait(lambda: harness.found_by(harness.node, "/rosout"), "the subscription to the log")
    publisher = StatePublisher(harness.node)
    drive = [
        (State.TRACKING, "", 0),
        (State.LOST, "few points fit", 0),
        (State.LOST, "few points fit", 0),
        (State.DEGRADED, "broken by a pause", 1),
        (State.TRACKING, "", 1),
    ]
    for state, reason, breaks in drive:
        publisher.send(result(state, reason, breaks))
    harness.wait(lambda: states and states[-1].data == "tracking" and len(log) >= 2, "the log")
    assert [message.msg for message in log if message.level >= LoggingSeverity.WARN] == [
        "lost: few points fit",
        "the odometry broke, its motion meanwhile is not known: broken by a pause",
    ]
