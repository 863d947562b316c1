# SPDX-License-Identifier: Apache-2.0
"""Assembles the keyframes of one drive from their messages, in order. Memory is bounded, whatever is received."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Container
from typing import Any

from dpm2_core.estimates import Keyframe

AHEAD = 64
"""Keyframes that may wait for an earlier one; those beyond are sent again."""
_MAX_ACK_IDS = 1000  # ids in one acknowledgment
_MAX_INCOMPLETE = 64  # incomplete keyframes that may wait; those beyond are also sent again
_GIVE_UP_TIME = 6.0  # s in which a robot sends a keyframe four times
_MIN_REJECTIONS = 3
Parts = dict[str, Any]
"""The received parts of a keyframe, each checked: `pose`, `cloud` (a `Payload`), `seen` (its descriptors, or None)."""
_PART_COUNT = 3


class Stream:
    """One drive, identified by its session. Without a session nothing is sent again, and the order is that of arrival.

    Attributes:
        next: all ids below it were passed to the mapper, or given up; without a session, the number that was.
        heard: when the last message arrived, s. since: when the first one arrived, anew once it was `replaced`.
        robot: its name in the map; None while that is not decided.
        last: the keyframe that was passed on last, without the cloud.
        odom_frame: the odometry frame that its keyframes name.
        taken: number of keyframes that were passed on.
        live: whether the robot's odometry is that of this drive.
    """

    def __init__(self, session: str, now: float) -> None:
        self.session, self.next, self.taken = session, 0, 0
        self.heard = self.since = now
        self.live = True
        self.acknowledged = -float("inf")
        self.robot: str | None = None
        self.last: Keyframe | None = None
        self.odom_frame = ""
        self._parts: OrderedDict[int, Parts] = OrderedDict()
        self._complete: dict[int, tuple[int, Parts]] = {}  # complete keyframes and ids, by id or counted from `next`
        self._passed_on: deque[tuple[int, int]] = deque()  # ids that were passed on, and the mapper's numbers for them
        self._rejections: tuple[float, int] | None = None  # since when, and how often, messages of `next` were rejected

    def arrived(self, written: int, missing: Container[int] = ()) -> tuple[int, list[int]]:
        """Ids that have arrived: all below a number, which are in the map file, and some above, which wait in memory.

        Args:
            written: all of the mapper's numbers below this are in its file, except those in `missing`.
        """
        while self._passed_on and (number := self._passed_on[0][1]) < written and number not in missing:
            self._passed_on.popleft()
        below = self._passed_on[0][0] if self._passed_on else self.next
        return below, [*range(below, self.next), *sorted(self._complete)][:_MAX_ACK_IDS]

    @property
    def holds(self) -> int:
        """Size of the messages that wait, bytes."""
        return sum(map(_size, [*self._parts.values(), *(parts for _, parts in self._complete.values())]))

    @property
    def ready(self) -> bool:
        """Whether the next keyframe is complete."""
        return self.next in self._complete

    def wants(self, id: int, part: str) -> bool:
        """Whether a part (pose, cloud or seen) of a keyframe is still missing."""
        if self.session and (not self.next <= id < self.next + AHEAD or id in self._complete):
            return False
        return part not in self._parts.get(id, ())

    def put(self, id: int, part: str, value: Any) -> bool:
        """Add a valid part; returns whether its keyframe is complete now."""
        parts = self._parts.setdefault(id, {})
        parts[part] = value
        if len(parts) < _PART_COUNT:
            while len(self._parts) > _MAX_INCOMPLETE:
                self._parts.popitem(last=False)
            return False
        del self._parts[id]
        self._complete[id if self.session else self.next + len(self._complete)] = id, parts
        if len(self._complete) > AHEAD:  # only without a session
            self.take()
        return True

    def take(self) -> tuple[int, Parts] | None:
        """Remove and return the next keyframe, if it is complete."""
        if not self.ready:
            return None
        self.next, self._rejections = self.next + 1, None
        return self._complete.pop(self.next - 1)

    def given(self, id: int, number: int) -> None:
        """Note that a keyframe was passed to the mapper, which gave it that number."""
        if self.session:
            self._passed_on.append((id, number))

    def reject(self, id: int, now: float) -> None:
        """Note that a message of a keyframe was invalid."""
        if self.session and id == self.next:
            since, count = self._rejections or (now, 0)
            self._rejections = since, count + 1

    def give_up(self, now: float) -> int | None:
        """Skip the next keyframe and return its id, if it was received repeatedly and never valid; else None."""
        if (
            self._rejections is None
            or not self._complete
            or now - self._rejections[0] < _GIVE_UP_TIME
            or self._rejections[1] < _MIN_REJECTIONS
        ):
            return None
        self._rejections, self.next = None, self.next + 1
        self._parts.pop(self.next - 1, None)
        return self.next - 1

    def drop(self) -> None:
        """Discard the messages that wait: they are sent again."""
        self._parts.clear()
        self._complete.clear()

    def replaced(self) -> None:
        """Another drive has replaced it. If it sends messages again, its robot is decided anew."""
        self.robot, self.last, self.since = None, None, float("inf")
        self.drop()

    def hear(self, now: float, live: bool = True) -> None:
        """Note that a message arrived; `live`: whether the drive is not over."""
        self.heard, self.since, self.live = now, min(self.since, now), live


def _size(parts: Parts) -> int:
    """Approximate size, bytes."""
    payload, descriptors = parts.get("cloud"), parts.get("seen")
    size = 2000 if payload is None else 2000 + len(payload.cloud) + len(payload.thumbnail or b"")
    return size if descriptors is None else size + int(descriptors.nbytes)
