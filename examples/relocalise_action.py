# SPDX-License-Identifier: Apache-2.0
"""A behavior tree action that relocalizes a lost robot in its map (py_trees, ROS 2).

python examples/relocalise_action.py [TIMEOUT]

Run it next to a slam_node with ros.localization_mode. The tree succeeds while the place of the robot is known, and
calls `Relocalise` if it is not. It ends when the place is known (exit code 0), or was not found within TIMEOUT s
(exit code 1).
"""

import sys
import time
from typing import Any

import py_trees
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from py_trees.common import Status
from rclpy.node import Node
from std_srvs.srv import Trigger

LOCATED = ("tracking", "degraded", "relocalised")
PATIENCE = 3.0
"""Seconds until a message on /diagnostics, published once per second, must have been received."""


class Localization:
    """The localization state that slam_node publishes on /diagnostics."""

    def __init__(self, node: Node) -> None:
        self.node, self.state = node, "unknown"
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(": localisation"):
                self.state = status.message.split(":")[0].split(" ")[0]


class IsLocated(py_trees.behaviour.Behaviour):
    """SUCCESS while the place in the map is known."""

    def __init__(self, localization: Localization) -> None:
        super().__init__("is located")
        self._localization, self._began = localization, time.monotonic()

    def update(self) -> Status:
        """One tick, called by py_trees."""
        if self._localization.state == "unknown" and time.monotonic() - self._began < PATIENCE:
            return Status.RUNNING
        return Status.SUCCESS if self._localization.state in LOCATED else Status.FAILURE


class Relocalise(py_trees.behaviour.Behaviour):
    """Starts a new search of the whole map in slam_node: RUNNING until it is found, FAILURE after `timeout` s."""

    def __init__(self, localization: Localization, timeout: float = 20.0) -> None:
        super().__init__("relocalise")
        self._localization, self._timeout = localization, timeout
        self._client = localization.node.create_client(Trigger, "/slam_node/load_map")
        self._reply: Any = None

    def initialise(self) -> None:
        """Starts the search."""
        self._began, self._reply, self._searching = time.monotonic(), None, False
        self.feedback_message = "searching"

    def update(self) -> Status:
        """One tick, called by py_trees."""
        if time.monotonic() - self._began > self._timeout:
            self.feedback_message = f"not found within {self._timeout:g} s"
            return Status.FAILURE
        if self._reply is None:
            if self._client.service_is_ready():
                self._reply = self._client.call_async(Trigger.Request())
            return Status.RUNNING
        if not self._reply.done():
            return Status.RUNNING
        if not self._reply.result().success:
            self.feedback_message = self._reply.result().message
            return Status.FAILURE
        if not self._searching:  # discard the state from before the search
            self._searching, self._localization.state = True, "searching"
            return Status.RUNNING
        return Status.SUCCESS if self._localization.state in LOCATED else Status.RUNNING


def main() -> int:
    """Tick the tree ten times per second until it succeeds or fails."""
    timeout = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    rclpy.init()
    node = rclpy.create_node("behavior")
    localization = Localization(node)
    tree = py_trees.composites.Selector("where am I", memory=True)
    relocalise = Relocalise(localization, timeout)
    tree.add_children([IsLocated(localization), relocalise])
    while tree.status not in (Status.SUCCESS, Status.FAILURE):
        end = time.monotonic() + 0.1
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
        tree.tick_once()
    print(f"{tree.status.value.lower()}: {localization.state} {relocalise.feedback_message}")
    rclpy.try_shutdown()
    return 0 if tree.status is Status.SUCCESS else 1


sys.exit(main())
