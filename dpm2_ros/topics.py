# SPDX-License-Identifier: Apache-2.0
"""The topics and services of the nodes, read from running nodes.

`python -m dpm2_ros.topics` writes docs/topics.md.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from dpm2_core.errors import exit_code
from dpm2_ros.runtime import end_ros, ros_context

_RCLPY_TOPICS = ("/parameter_events", "/rosout", "/clock")
_HEAD = """# Topics and services

<!-- Written by `make topics` from running nodes; a test keeps it up to date. -->

As the nodes have them by default, outside any namespace; what each is for: [nodes](ros2.md#topics).
Subscriptions to clouds and images follow their publisher's QoS.
"""


class Endpoint(NamedTuple):
    """One line: name, package/Type, what the node does with it, and its QoS in words."""

    name: str
    kind: str
    role: str
    qos: str


def endpoints(node: Any) -> Iterator[Endpoint]:
    """Publishers, then subscriptions, then services of a node, each kind by name."""
    for role, found in (("publishes", node.publishers), ("subscribes", node.subscriptions)):
        for one in sorted(found, key=lambda one: str(one.topic_name)):
            if one.topic_name not in _RCLPY_TOPICS:
                yield Endpoint(one.topic_name, _type_name(one.msg_type), role, _qos(one.qos_profile))
    for service in sorted(node.services, key=lambda service: str(service.srv_name)):
        if service.srv_type.__module__.split(".")[0] not in ("rcl_interfaces", "type_description_interfaces"):
            yield Endpoint(service.srv_name, _type_name(service.srv_type), "serves", "")


def describe() -> dict[str, list[Endpoint]]:
    """The endpoints of slam_node and mapper_node, which are created one after the other; ROS must be initialized."""
    from dpm2_ros.mapper_node import MapperNode
    from dpm2_ros.slam_node import SlamNode

    makers: dict[str, Callable[[], Any]] = {"slam_node": SlamNode, "mapper_node": MapperNode}
    found = {}
    for name, make in makers.items():
        node = make()
        try:
            found[name] = list(dict.fromkeys(endpoints(node)))  # two parts of a node may have the same publisher
        finally:
            node.close()
            node.destroy_node()
    return found


def page(nodes: dict[str, list[Endpoint]]) -> str:
    """Markdown: a table for each node."""
    parts = [_HEAD]
    for node, found in nodes.items():
        rows = [f"| `{e.name}` | {e.kind} | {e.role} | {e.qos} |" for e in found]
        parts.append("\n".join([f"## {node}", "", "| name | type | | QoS |", "|---|---|---|---|", *rows, ""]))
    return "\n".join(parts)


def main() -> int:
    """Print the page."""

    def work() -> None:
        with tempfile.TemporaryDirectory() as folder:
            ros_context(["--ros-args", "-p", f"ros.map_directory:={folder}"])
            try:
                sys.stdout.write(page(describe()))
            finally:
                end_ros()

    return exit_code(work)


def _type_name(kind: Any) -> str:
    return f"{kind.__module__.split('.')[0]}/{kind.__name__}"


def _qos(profile: Any) -> str:
    words = [profile.reliability.name.lower().replace("_", " ")]
    if profile.durability.name == "TRANSIENT_LOCAL":
        words.append("transient local")
    words.append("keep all" if profile.history.name == "KEEP_ALL" else str(profile.depth))
    return ", ".join(words)


if __name__ == "__main__":
    sys.exit(main())
