# SPDX-License-Identifier: Apache-2.0
"""Which clouds are accepted, and when one has waited long enough for what goes with it. Pure: no ROS, no clock, no
thread.

Images of one or two cameras go with it, and the cloud of a second LiDAR.

Every accepted cloud leaves exactly once, in order, with these by the rules of `dpm2_core.data.pairing`. It leaves as
soon as there is one of each within the tolerance: a nearer one that may be on its way is not worth the wait.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from dpm2_core.data.pairing import AHEAD, JUMP, Beside, SetBack, is_due, passed

HOLD = 0.5
"""Longest wait (s) for the next stamp, which confirms a jump."""
FEW = 2
"""Clouds that may wait at least where they come faster than they can be processed."""
PATIENCE = 5
"""Clouds in a row that a sensor may miss before clouds no longer wait for it (until it delivers again)."""


class StampCheck(StrEnum):
    """What became of an incoming cloud."""

    ACCEPTED = "accepted"
    RESTARTED = "restarted"
    """Accepted, and time has gone back."""
    REPEATED = "repeated"
    """Rejected: its stamp is that of the cloud before."""
    OUT_OF_ORDER = "out of order"
    """Rejected: a later cloud has been accepted already. Unless more follow, see `SET_BACK`."""
    SET_BACK = "its clock was set back by less than a second; the drive goes on"
    """Accepted, as are those right before it that were out of order; counted as accepted."""
    JUMPED = "the stamp jumps; the next one shows whether it is right"
    """Neither accepted nor rejected yet; counted as what becomes of it."""
    STRAY = "stray"
    """Rejected: its stamp jumped, and the next one did not."""


@dataclass(eq=False)
class Bundle:
    """A cloud and what goes with it, ready to be processed; arrival and `now` are seconds of one clock, `clock` is when
    it arrived by the clock of a recording or a simulation, s, or 0 without one."""

    stamp: int
    cloud: Any
    arrival: float
    clock: float
    restarted: bool
    """Whether time has gone back before it."""
    stepped: bool = False
    """Whether it has gone on by more than has passed."""
    beside: dict[str, tuple[int, Any]] = field(default_factory=dict)
    """Topic of each other sensor that has one to stamp (ns) and message."""
    dropped: int = 0
    """Clouds right before it that were."""


@dataclass(eq=False)
class SensorState:
    """What a sensor beside the LiDAR has delivered."""

    messages: Beside
    received: int = 0
    matched: int = 0
    late: int = 0
    """Messages for which a cloud had not waited."""
    missed: int = 0
    """Clouds in a row that left without it, since one came that was in time or ahead."""
    unused: int = 0
    """Messages in a row that went with no cloud."""
    without: int = 0
    """Clouds in a row that left without it, whether they had waited or not."""
    last_arrival: float | None = None
    present: bool = True
    """Whether there is a publisher; clouds do not wait for a sensor without one."""

    @property
    def awaited(self) -> bool:
        """Whether a cloud still waits for this sensor."""
        return self.missed < PATIENCE

    @property
    def fits(self) -> bool:
        """Whether its messages go with clouds: most of a fast one go with none, and most clouds miss a slow one."""
        return self.without < PATIENCE or self.unused < PATIENCE

    def waits(self, stamp: int) -> bool:
        """Whether a cloud of that stamp (ns) should."""
        return self.present and self.awaited and not passed(self.messages.last, stamp)


class Synchronizer:
    """A bounded queue of clouds, each waiting for what goes with it.

    Args:
        beside: topics of the other sensors. Without any, nothing waits.
        depth: clouds that may wait; when full, the oldest is dropped. Where clouds keep coming faster than they go, one
            fewer may wait each time, down to `FEW`: as many are lost, but those that go are not old.
        timeout: longest wait of a cloud, s.
        tolerance: greatest difference of stamps that belong together, s.

    Attributes:
        sensors: those, by topic.
        left: the last cloud that went; None before one has.
    """

    def __init__(self, beside: Iterable[str], depth: int, timeout: float, tolerance: float) -> None:
        self.sensors = {topic: SensorState(Beside(tolerance)) for topic in beside}
        self.counts: dict[StampCheck, int] = dict.fromkeys(StampCheck, 0)
        self.dropped = 0
        self.last_arrival: float | None = None
        self._timeout = timeout
        self._queue: deque[Bundle] = deque()
        self._depth = self._room = depth  # what may wait in general, and now
        self._moves = False  # whether a cloud has gone since the last was dropped: too slow, but not held up
        self._newest: Bundle | None = None  # the last one accepted
        self._period = JUMP  # ns, from the last but one to that
        self._jumped: Bundle | None = None
        self._set_back = SetBack()
        self.left: Bundle | None = None

    def __len__(self) -> int:
        """Clouds that are waiting."""
        return len(self._queue) + (self._jumped is not None)

    @property
    def received(self) -> int:
        """Clouds that have come in."""
        return sum(self.counts.values()) + (self._jumped is not None)

    def follow(self, left: Bundle | None) -> None:
        """Go on where another one has ended: what is its `left`."""
        self.left = self._newest = left

    def add_cloud(self, stamp: int, cloud: Any, now: float, clock: float = 0.0) -> StampCheck:
        """Take a cloud with its stamp (ns); `now` is when it arrived, `clock` as of `Bundle`."""
        self.last_arrival = now
        bundle = Bundle(stamp, cloud, now, clock, restarted=False)
        if self._jumped is not None and self._newest is not None:
            self._settle(abs(stamp - self._jumped.stamp) < abs(stamp - self._newest.stamp), bundle)
        check = self._check(bundle)
        if check is StampCheck.JUMPED:
            self._jumped = bundle
            return check
        self.counts[check] += 1
        late = list[Bundle]()
        if check is StampCheck.ACCEPTED:
            before = self._set_back.end()
            late = before if before and self._came_in_time(before[0], bundle) else []
        elif check is StampCheck.OUT_OF_ORDER:
            late = self._set_back.add(stamp, bundle)
        self.counts[StampCheck.OUT_OF_ORDER] -= len(late)
        self.counts[StampCheck.ACCEPTED] += len(late)
        for one in (*late, *[bundle] * (check is StampCheck.ACCEPTED)):
            self._accept(one)
        return StampCheck.SET_BACK if late else check

    def _came_in_time(self, late: Bundle, bundle: Bundle) -> bool:
        """Whether the clouds from one that was out of order to this one came at the pace of their stamps, and more time
        has passed than these say since the last one in order: the clock was set back, and nothing was kept on the way.
        """
        return self._on_pace(bundle, late) and self._ahead(bundle, self._newest) < -self._period / 2

    def _came_at_once(self, bundle: Bundle, following: Bundle | None) -> bool:
        """Whether one that is ahead came a period after the last, and the one after it at the pace of their stamps: the
        clock was set; where clouds were lost or kept on the way one of the two is not so. Where none follows, as in
        lockstep, /clock alone tells.
        """
        last = self._newest
        if last is None or bundle.stamp < last.stamp:
            return False
        passed = bundle.clock - last.clock if last.clock else bundle.arrival - last.arrival
        told = bool(last.clock) if following is None else self._on_pace(following, bundle)
        return told and is_due(passed * 1e9, self._period)

    def _on_pace(self, bundle: Bundle, last: Bundle) -> bool:
        """Whether the stamps have gone on from that cloud by as much as has passed."""
        return abs(self._ahead(bundle, last)) < self._period / 3

    def due(self, stamp: int, now: float, clock: float = 0.0) -> bool:
        """Whether a cloud of that stamp (ns) would be accepted as the next one of the drive."""
        due = Bundle(stamp, None, now, clock, restarted=False)
        return self._newest is not None and self._check(due) is StampCheck.ACCEPTED

    def add(self, topic: str, stamp: int, message: Any, now: float) -> None:
        """Take a message of another sensor with its stamp (ns)."""
        sensor, left = self.sensors[topic], self.left
        tolerance = sensor.messages.tolerance
        sensor.received += 1
        sensor.unused += 1
        sensor.last_arrival = now
        late = left is not None and -JUMP < stamp - left.stamp <= (tolerance if sensor.missed else -tolerance)
        sensor.late += late
        if left is None or (not late and abs(stamp - left.stamp) < JUMP):  # by more it may be of another clock
            sensor.missed = 0
        elif late and stamp - left.stamp >= -tolerance and now <= left.arrival + self._timeout:
            sensor.missed = 0  # it would have come in time, had that cloud waited
        sensor.messages.add(stamp, message, [bundle.stamp for bundle in self._queue])

    def pop(self, now: float) -> Bundle | None:
        """The next cloud that has what goes with it or has waited long enough; None if there is none yet."""
        if self._jumped is not None and now >= self._jumped.arrival + HOLD:
            self._settle(true=True)
        ready = self._ready(now)
        if ready is None:  # who asks is not behind
            self._room = self._depth
        else:
            self.left, self._moves = ready, True
        return ready

    def _ready(self, now: float) -> Bundle | None:
        """Takes the next cloud from the queue, if it need not wait."""
        if not self._queue:
            return None
        head, sensors = self._queue[0], self.sensors
        found = {topic: sensor.messages.nearest(head.stamp) for topic, sensor in sensors.items()}
        missing = [sensors[topic] for topic, message in found.items() if message is None]
        if now < head.arrival + self._timeout and any(sensor.waits(head.stamp) for sensor in missing):
            return None
        for topic, sensor in sensors.items():
            if found[topic] is None:
                sensor.missed, sensor.without = sensor.missed + 1, sensor.without + 1
            else:
                sensor.matched, sensor.missed, sensor.without, sensor.unused = sensor.matched + 1, 0, 0, 0
            sensor.messages.forget(head.stamp)
        head.beside = {topic: message for topic, message in found.items() if message is not None}
        self._queue.popleft()
        return head

    def deadline(self) -> float | None:
        """When the next cloud will have waited long enough; None if none waits."""
        if self._queue:
            return self._queue[0].arrival + self._timeout
        return self._jumped.arrival + HOLD if self._jumped is not None else None

    def _check(self, bundle: Bundle) -> StampCheck:
        if self._newest is None:
            return StampCheck.ACCEPTED
        step = bundle.stamp - self._newest.stamp
        if step < -JUMP or self._ahead(bundle, self._newest) > min(AHEAD * self._period, JUMP):
            return StampCheck.JUMPED
        if step > 0:
            return StampCheck.ACCEPTED
        return StampCheck.OUT_OF_ORDER if step else StampCheck.REPEATED

    @staticmethod
    def _ahead(bundle: Bundle, last: Bundle | None) -> float:
        """By how much more (ns) the stamps have gone on than time has passed since that cloud.

        A recording that is played faster passes more time than one who listens, and /clock says how much.
        """
        if last is None:
            return 0.0
        passed = max(bundle.arrival - last.arrival, bundle.clock - last.clock if last.clock else 0.0)
        return bundle.stamp - last.stamp - passed * 1e9

    def _settle(self, true: bool, following: Bundle | None = None) -> None:
        """Accept or reject the cloud whose stamp jumped; `following`: the next one, where it is there."""
        bundle, self._jumped = self._jumped, None
        if bundle is None or self._newest is None:
            return
        bundle.restarted = true and bundle.stamp < self._newest.stamp
        ahead = self._ahead(bundle, self._newest)
        bundle.stepped = true and (ahead > JUMP or self._came_at_once(bundle, following))
        self.counts[
            StampCheck.RESTARTED if bundle.restarted else StampCheck.ACCEPTED if true else StampCheck.STRAY
        ] += 1
        if true:
            self._accept(bundle)

    def _accept(self, bundle: Bundle) -> None:
        if self._newest is not None and bundle.stamp > self._newest.stamp:
            self._period = bundle.stamp - self._newest.stamp
        self._newest = bundle
        self._queue.append(bundle)
        if len(self._queue) > self._room and self._moves:
            self._room, self._moves = max(self._room - 1, min(FEW, self._depth)), False
        while len(self._queue) > self._room:
            oldest = self._queue.popleft()
            self._queue[0].restarted |= oldest.restarted  # not lost with the cloud that announced it
            self._queue[0].stepped |= oldest.stepped
            self._queue[0].dropped += oldest.dropped + 1
            self.dropped += 1
