# SPDX-License-Identifier: Apache-2.0
"""Keyframes of one drive put together from their messages, in their order; whatever comes, memory is bounded."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Container
from typing import Any

from dpm2_core.estimates import Keyframe

AHEAD = 64
"""Keyframes that may wait for one before them; those beyond are sent again."""
_MOST_WAITING = 1000  # of which a robot is told at once
_HALVES = 64  # keyframes of which some messages are missing; also sent again
_STUCK = 6.0  # s in which a robot sends a keyframe four times
_TIMES = 3
Parts = dict[str, Any]
"""What has come of a keyframe, each part checked: `pose`, `cloud` (a `Payload`), `seen` (its descriptors, or None)."""
_WHOLE = 3


class Stream:
    """One drive, known by its session; without a session nothing is sent again, and order is arrival.

    Attributes:
        next: all ids below have gone on to the mapper, or were given up; without a session, so many have.
        heard: when the last message came, s. since: when the first one came, since another drive took its place.
        robot: what the map calls it; None while that is not decided.
        last: its keyframe that went on last, without the cloud.
        odom_frame: that its keyframes name.
        taken: keyframes that went on.
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
        self._above: dict[int, tuple[int, Parts]] = {}  # whole keyframes with their ids, by id, or in turn from `next`
        self._given: deque[tuple[int, int]] = deque()  # ids that have gone on, and the mapper's numbers for them
        self._bad: tuple[float, int] | None = None  # since when, and how often, messages of the next one were rejected

    def arrived(self, written: int, missing: Container[int] = ()) -> tuple[int, list[int]]:
        """Ids that have come: all below a number, which are in the map file, and some above, which wait in memory.

        Args:
            written: of the mapper's numbers, how many are in its file. missing: those of them that are not.
        """
        while self._given and (number := self._given[0][1]) < written and number not in missing:
            self._given.popleft()
        below = self._given[0][0] if self._given else self.next
        return below, [*range(below, self.next), *sorted(self._above)][:_MOST_WAITING]

    @property
    def holds(self) -> int:
        """Bytes."""
        return sum(map(_size, [*self._parts.values(), *(parts for _, parts in self._above.values())]))

    @property
    def ready(self) -> bool:
        """Whether the next keyframe is there."""
        return self.next in self._above

    def wants(self, id: int, part: str) -> bool:
        """Whether a message would add anything: pose, cloud, or seen."""
        if self.session and (not self.next <= id < self.next + AHEAD or id in self._above):
            return False
        return part not in self._parts.get(id, ())

    def put(self, id: int, part: str, value: Any) -> bool:
        """A part that is sound; whether its keyframe is complete now."""
        parts = self._parts.setdefault(id, {})
        parts[part] = value
        if len(parts) < _WHOLE:
            while len(self._parts) > _HALVES:
                self._parts.popitem(last=False)
            return False
        del self._parts[id]
        self._above[id if self.session else self.next + len(self._above)] = id, parts
        if len(self._above) > AHEAD:  # only without a session
            self.take()
        return True

    def take(self) -> tuple[int, Parts] | None:
        """The next keyframe, if it is there."""
        if not self.ready:
            return None
        self.next, self._bad = self.next + 1, None
        return self._above.pop(self.next - 1)

    def given(self, id: int, number: int) -> None:
        """The mapper has been handed a keyframe, and calls it by that number."""
        if self.session:
            self._given.append((id, number))

    def reject(self, id: int, now: float) -> None:
        """A message of a keyframe was not sound."""
        if self.session and id == self.next:
            since, times = self._bad or (now, 0)
            self._bad = since, times + 1

    def give_up(self, now: float) -> int | None:
        """The id of the next keyframe if it came again and again and was never sound: those after it go on."""
        if self._bad is None or not self._above or now - self._bad[0] < _STUCK or self._bad[1] < _TIMES:
            return None
        self._bad, self.next = None, self.next + 1
        self._parts.pop(self.next - 1, None)
        return self.next - 1

    def drop(self) -> None:
        """Forget what waits: it is sent again."""
        self._parts.clear()
        self._above.clear()

    def replaced(self) -> None:
        """Another drive has taken its place; should it be heard again, its place is decided anew."""
        self.robot, self.last, self.since = None, None, float("inf")
        self.drop()

    def hear(self, now: float, live: bool = True) -> None:
        """A message came; `live`: the robot still drives it."""
        self.heard, self.since, self.live = now, min(self.since, now), live


def _size(parts: Parts) -> int:
    """Bytes, roughly."""
    payload, descriptors = parts.get("cloud"), parts.get("seen")
    size = 2000 if payload is None else 2000 + len(payload.cloud) + len(payload.thumbnail or b"")
    return size if descriptors is None else size + int(descriptors.nbytes)
