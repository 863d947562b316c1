# SPDX-License-Identifier: Apache-2.0
"""What all nodes report on /diagnostics: the state of the map, and the rejected messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from dpm2_ros.guard import GuardedNode, excerpt
from dpm2_ros.mapping import BEHIND, MapperThread

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE
PERIOD = 1.0
"""s between two messages."""
_RECENT_TIME = 10.0  # s
_MAX_TEXT_LENGTH = 1000  # characters of a text, which may quote a message


def publish_diagnostics(node: GuardedNode, statuses: Callable[[], list[DiagnosticStatus]]) -> None:
    """Publish the statuses every `PERIOD` from now on."""
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publish() -> None:
        message = DiagnosticArray(status=statuses())
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)

    node.create_timer(PERIOD, publish)


def status(node: GuardedNode, part: str, level: bytes, text: str, figures: Mapping[str, object]) -> DiagnosticStatus:
    """The status of a part of a node."""
    values = [KeyValue(key=key, value=excerpt(str(value), _MAX_TEXT_LENGTH)) for key, value in figures.items()]
    name = f"{node.get_fully_qualified_name().lstrip('/')}: {part}"
    return DiagnosticStatus(
        level=level, name=name, message=excerpt(text, _MAX_TEXT_LENGTH), hardware_id="", values=values
    )


def mapper_status(node: GuardedNode, mapper: MapperThread) -> DiagnosticStatus:
    """The status of a growing map: its size, and the problems of its file and its poses."""
    core = mapper.active.mapper
    loops = [loop.ok for loop in core.loops]
    figures = {"keyframes": mapper.keyframes, "loops accepted": sum(loops), "loops tried": len(loops)}
    problems = []
    if mapper.waiting > BEHIND:
        problems.append(f"{mapper.waiting} keyframes wait: the map, its loops and map -> odom are behind")
    if problem := mapper.active.file_problem:
        problems.append(f"no map file, the map is only in memory: {problem}")
    if mapper.store_problem:
        problems.append(f"map file incomplete: {mapper.store_problem}")
    if problem := core.graph.problem:
        problems.append(f"poses not optimized: {problem}")
    if problem := mapper.tf.problem():
        problems.append(problem)
    if missing := list(mapper.missing.values()):
        problems.append(f"{len(missing)} keyframes could not be added to the map: {missing[-1]}")
    text = "; ".join([f"{mapper.keyframes} keyframes, {sum(loops)} loops", *problems])
    return status(node, "mapper", WARN if problems else OK, text, figures | {"waiting": mapper.waiting})


def message_status(node: GuardedNode) -> DiagnosticStatus:
    """The status of the received messages: how many were rejected, by topic and reason."""
    rejections = node.rejections
    total = sum(rejections.values())
    level, text = OK, f"{total} messages rejected"
    if node.since_rejection < _RECENT_TIME:
        level, text = WARN, f"{text}, the last {node.since_rejection:.0f} s ago"
    if node.errors:
        level, text = WARN, f"{text}; {node.errors} internal errors"
    return status(node, "messages", level, text, {**rejections, "internal errors": node.errors})
