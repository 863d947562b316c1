# SPDX-License-Identifier: Apache-2.0
"""Tests whether DDS transfers a message of a cloud's size from one process to another, for `dpm2 doctor`.

`python -m dpm2_ros.round_trip` prints {"rmw": its name, "ms": from sending to receiving} as JSON.
"""

from __future__ import annotations

import array
import json
import os
import subprocess
import sys
import time

import rclpy
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import UInt8MultiArray

from dpm2_core.errors import Dpm2Error, exit_code
from dpm2_ros.runtime import end_ros, ros_context

SIZE = 2_000_000
"""Bytes: 120,000 points."""
_SEND_TIME = 10.0  # s during which messages are sent


def receive(topic: str) -> dict[str, object]:
    """Start a process that sends, and wait for its messages.

    Raises:
        Dpm2Error: none arrived.
    """
    ros_context([])
    node = rclpy.create_node("dpm2_round_trip_receiver")
    arrived: list[float] = []

    def on_message(message: UInt8MultiArray) -> None:
        sent = int.from_bytes(bytes(message.data[:8]), "little")
        arrived.append((time.time_ns() - sent) / 1e6)

    node.create_subscription(UInt8MultiArray, topic, on_message, qos_profile_sensor_data)
    sender = subprocess.Popen([sys.executable, "-m", "dpm2_ros.round_trip", topic])
    try:
        while len(arrived) < 3 and sender.poll() is None:  # it ends by itself, however long its start takes
            rclpy.spin_once(node, timeout_sec=0.1)
    finally:
        sender.terminate()
        sender.wait()
        end_ros(node)
    if not arrived:
        raise Dpm2Error(f"no message of {SIZE} bytes came from another process within {_SEND_TIME:g} s")
    return {"rmw": rclpy.get_rmw_implementation_identifier(), "ms": min(arrived)}


def send(topic: str) -> None:
    """Send five messages per second, until the process is ended, but at most for `_SEND_TIME`."""
    ros_context([])
    node = rclpy.create_node("dpm2_round_trip_sender")
    publisher = node.create_publisher(UInt8MultiArray, topic, qos_profile_sensor_data)
    end = time.monotonic() + _SEND_TIME
    while time.monotonic() < end:
        content = time.time_ns().to_bytes(8, "little") + bytes(SIZE - 8)
        publisher.publish(UInt8MultiArray(data=array.array("B", content)))
        time.sleep(0.2)


def main() -> int:
    """Run the receiver or, with a topic as argument, the sender."""
    if len(sys.argv) > 1:
        return exit_code(lambda: send(sys.argv[1]))
    return exit_code(lambda: print(json.dumps(receive(f"/dpm2_round_trip_{os.getpid()}"))))


if __name__ == "__main__":
    sys.exit(main())
