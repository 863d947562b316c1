# SPDX-License-Identifier: Apache-2.0
"""Accepts or rejects clouds, and synchronizes each with messages of the other sensors: images of one or two cameras,
and the cloud of a second LiDAR. Pure logic: no ROS, no clock, no thread.

Each accepted cloud is released exactly once and in order, together with the messages that `dpm2_core.data.pairing`
associates with it. It is released as soon as every sensor has a message within the tolerance; it does not wait for a
closer one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from dpm2_core.data.pairing import AHEAD, JUMP, Beside, SetBack, is_due, passed
from dpm2_core.data.sweep_parts import MAX_PART_SPAN, SWEEP

HOLD = 0.5
"""Longest wait (s) for the next stamp, which confirms a jump of the stamps."""
FEW = 2
"""Smallest limit of the queue when clouds arrive faster than they can be processed."""
PATIENCE = 5
"""Consecutive clouds that a sensor may miss before clouds no longer wait for it (until it delivers again)."""


_MIN_PART_PERIOD = 1e-4
"""s: no driver sends parts of a sweep faster."""


class StampCheck(StrEnum):
    """Whether an incoming cloud is accepted, and why not."""

    ACCEPTED = "accepted"
    RESTARTED = "restarted"
    """Accepted, and time has gone back."""
    REPEATED = "repeated"
    """Rejected: it has the stamp of the previous cloud."""
    OUT_OF_ORDER = "out of order"
    """Rejected: a later cloud has been accepted already. Unless more follow, see `SET_BACK`."""
    SET_BACK = "its clock was set back by less than a second; the drive continues"
    """Accepted, together with the out-of-order clouds right before it; counted as accepted."""
    JUMPED = "the stamp jumps; the next one shows whether it is right"
    """Neither accepted nor rejected yet; counted once that is decided."""
    STRAY = "stray"
    """Rejected: its stamp jumped, and the next one did not."""


@dataclass(eq=False)
class Bundle:
    """A cloud and the messages synchronized with it, ready to be processed. `arrival` is in seconds of the same clock
    as `now` in `Synchronizer`; `clock` is the arrival by the clock of a recording or a simulation, s, or 0 without one.
    """

    stamp: int
    cloud: Any
    arrival: float
    clock: float
    restarted: bool
    """Whether time went back before this cloud."""
    stepped: bool = False
    """Whether the stamps advanced by more than the time that has passed."""
    beside: dict[str, tuple[int, Any]] = field(default_factory=dict)
    """Topic of each other sensor that has a message for this cloud, to stamp (ns) and message."""
    dropped: int = 0
    """Number of clouds right before it that were dropped."""


@dataclass(eq=False)
class SensorState:
    """What a sensor other than the LiDAR has delivered."""

    messages: Beside
    received: int = 0
    matched: int = 0
    late: int = 0
    """Messages that arrived after their cloud was released."""
    missed: int = 0
    """Consecutive clouds released without it, since its last message that was in time or ahead."""
    unused: int = 0
    """Consecutive messages that were synchronized with no cloud."""
    without: int = 0
    """Consecutive clouds released without it, whether they had waited or not."""
    last_arrival: float | None = None
    present: bool = True
    """Whether the topic has a publisher; clouds do not wait for a sensor without one."""

    @property
    def awaited(self) -> bool:
        """Whether clouds still wait for this sensor."""
        return self.missed < PATIENCE

    @property
    def fits(self) -> bool:
        """Whether its messages can be synchronized with clouds. Most messages of a fast sensor match no cloud, and most
        clouds have no message of a slow one, so that only both together show a problem."""
        return self.without < PATIENCE or self.unused < PATIENCE

    def waits(self, stamp: int) -> bool:
        """Whether a cloud with that stamp (ns) should wait for this sensor."""
        return self.present and self.awaited and not passed(self.messages.last, stamp)


class Synchronizer:
    """A bounded queue of clouds, each waiting for the messages of the other sensors.

    Args:
        beside: topics of the other sensors. Without any, no cloud waits.
        depth: limit of `filled`; when it is reached, the oldest cloud is dropped, or the oldest parts that make up a
            sweep: with a hole in every sweep, none could be registered. While clouds arrive faster than they are
            processed, the limit shrinks by one each time, down to `FEW`. Just as many clouds are dropped then, but the
            remaining ones are more recent.
        timeout: longest wait of a cloud, s.
        tolerance: largest difference of the stamps of synchronized messages, s.

    Attributes:
        sensors: the other sensors, by topic.
        left: the last cloud that was released; None before the first.
    """

    def __init__(self, beside: Iterable[str], depth: int, timeout: float, tolerance: float) -> None:
        self.sensors = {topic: SensorState(Beside(tolerance)) for topic in beside}
        self.counts: dict[StampCheck, int] = dict.fromkeys(StampCheck, 0)
        self.dropped = 0
        self.last_arrival: float | None = None
        self._timeout = timeout
        self._queue: deque[Bundle] = deque()
        self._depth = self._current_depth = depth  # limit of the queue in general, and at present
        self._released_since_drop = False  # if a cloud was: the worker is slow, but not blocked
        self._newest: Bundle | None = None  # the last accepted cloud
        self._period = JUMP  # ns, between the last two accepted clouds
        self._jumped: Bundle | None = None
        self._set_back = SetBack()
        self.left: Bundle | None = None

    def __len__(self) -> int:
        """Number of clouds that are waiting."""
        return len(self._queue) + (self._jumped is not None)

    @property
    def filled(self) -> float:
        """Number of clouds that are waiting; if they are parts of a sweep, the number of sweeps."""
        span = self._span_of_parts
        return span / SWEEP if span else len(self)

    @property
    def _span_of_parts(self) -> float:
        """s from the first cloud in the queue to the last; 0 unless they are parts of a sweep."""
        queue = self._queue
        span = (queue[-1].stamp - queue[0].stamp) * 1e-9 if queue else 0.0
        return span if _MIN_PART_PERIOD <= span / max(len(queue) - 1, 1) < MAX_PART_SPAN else 0.0

    @property
    def received(self) -> int:
        """Number of clouds that have arrived."""
        return sum(self.counts.values()) + (self._jumped is not None)

    def follow(self, left: Bundle | None) -> None:
        """Continue where another synchronizer ended; `left`: its attribute of that name."""
        self.left = self._newest = left

    def add_cloud(self, stamp: int, cloud: Any, now: float, clock: float = 0.0) -> StampCheck:
        """Add a cloud with its stamp (ns); `now` is when it arrived, `clock` as in `Bundle`."""
        self.last_arrival = now
        bundle = Bundle(stamp, cloud, now, clock, restarted=False)
        if self._jumped is not None and self._newest is not None:
            self._decide_jump(abs(stamp - self._jumped.stamp) < abs(stamp - self._newest.stamp), bundle)
        check = self._check(bundle)
        if check is StampCheck.JUMPED:
            self._jumped = bundle
            return check
        self.counts[check] += 1
        late = list[Bundle]()
        if check is StampCheck.ACCEPTED:
            earlier = self._set_back.end()
            late = earlier if earlier and self._was_set_back(earlier[0], bundle) else []
        elif check is StampCheck.OUT_OF_ORDER:
            late = self._set_back.add(stamp, bundle)
        self.counts[StampCheck.OUT_OF_ORDER] -= len(late)
        self.counts[StampCheck.ACCEPTED] += len(late)
        for one in (*late, *[bundle] * (check is StampCheck.ACCEPTED)):
            self._accept(one)
        return StampCheck.SET_BACK if late else check

    def _was_set_back(self, late: Bundle, bundle: Bundle) -> bool:
        """Whether the sensor's clock was set back. Then the clouds from the out-of-order `late` to `bundle` arrived at
        the pace of their stamps, and since the last cloud in order more time has passed than the stamps show. Clouds
        that were delayed on the way do not arrive like this."""
        return self._is_on_pace(bundle, late) and self._stamp_lead(bundle, self._newest) < -self._period / 2

    def _was_set_forward(self, bundle: Bundle, following: Bundle | None) -> bool:
        """Whether the sensor's clock was set forward before this cloud. Then it arrived one period after the last, and
        the `following` one at the pace of the stamps; if clouds were lost or delayed, one of the two is false. If none
        follows, as in lockstep, only /clock can show it."""
        last = self._newest
        if last is None or bundle.stamp < last.stamp:
            return False
        elapsed = bundle.clock - last.clock if last.clock else bundle.arrival - last.arrival
        is_known = bool(last.clock) if following is None else self._is_on_pace(following, bundle)
        return is_known and is_due(elapsed * 1e9, self._period)

    def _is_on_pace(self, bundle: Bundle, last: Bundle) -> bool:
        """Whether the stamps have advanced since that cloud by as much as the time."""
        return abs(self._stamp_lead(bundle, last)) < self._period / 3

    def due(self, stamp: int, now: float, clock: float = 0.0) -> bool:
        """Whether a cloud of that stamp (ns) would be accepted as the next one of the drive."""
        due = Bundle(stamp, None, now, clock, restarted=False)
        return self._newest is not None and self._check(due) is StampCheck.ACCEPTED

    def add(self, topic: str, stamp: int, message: Any, now: float) -> None:
        """Add a message of another sensor with its stamp (ns)."""
        sensor, left = self.sensors[topic], self.left
        tolerance = sensor.messages.tolerance
        sensor.received += 1
        sensor.unused += 1
        sensor.last_arrival = now
        late = left is not None and -JUMP < stamp - left.stamp <= (tolerance if sensor.missed else -tolerance)
        sensor.late += late
        if left is None or (not late and abs(stamp - left.stamp) < JUMP):  # beyond that it may be of another clock
            sensor.missed = 0
        elif late and stamp - left.stamp >= -tolerance and now <= left.arrival + self._timeout:
            sensor.missed = 0  # it would have been in time, if that cloud had waited
        sensor.messages.add(stamp, message, [bundle.stamp for bundle in self._queue])

    def pop(self, now: float) -> Bundle | None:
        """The next cloud that has its messages or has waited long enough; None if there is none yet."""
        if self._jumped is not None and now >= self._jumped.arrival + HOLD:
            self._decide_jump(is_valid=True)
        ready = self._pop_ready(now)
        if ready is None:  # the consumer keeps up
            self._current_depth = self._depth
        else:
            self.left, self._released_since_drop = ready, True
        return ready

    def _pop_ready(self, now: float) -> Bundle | None:
        """Take the next cloud from the queue, if it need not wait."""
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
        if step < -JUMP or self._stamp_lead(bundle, self._newest) > min(AHEAD * self._period, JUMP):
            return StampCheck.JUMPED
        if step > 0:
            return StampCheck.ACCEPTED
        return StampCheck.OUT_OF_ORDER if step else StampCheck.REPEATED

    @staticmethod
    def _stamp_lead(bundle: Bundle, last: Bundle | None) -> float:
        """By how much more (ns) the stamps have advanced since that cloud than the time.

        In a recording that is played faster, more time passes than for the receiver; /clock shows how much.
        """
        if last is None:
            return 0.0
        elapsed = max(bundle.arrival - last.arrival, bundle.clock - last.clock if last.clock else 0.0)
        return bundle.stamp - last.stamp - elapsed * 1e9

    def _decide_jump(self, is_valid: bool, following: Bundle | None = None) -> None:
        """Accept or reject the cloud whose stamp jumped; `following`: the next one, if it has arrived."""
        bundle, self._jumped = self._jumped, None
        if bundle is None or self._newest is None:
            return
        bundle.restarted = is_valid and bundle.stamp < self._newest.stamp
        lead = self._stamp_lead(bundle, self._newest)
        bundle.stepped = is_valid and (lead > JUMP or self._was_set_forward(bundle, following))
        self.counts[
            StampCheck.RESTARTED if bundle.restarted else StampCheck.ACCEPTED if is_valid else StampCheck.STRAY
        ] += 1
        if is_valid:
            self._accept(bundle)

    def _accept(self, bundle: Bundle) -> None:
        if self._newest is not None and bundle.stamp > self._newest.stamp:
            self._period = bundle.stamp - self._newest.stamp
        self._newest = bundle
        self._queue.append(bundle)
        if self.filled <= self._current_depth:
            return
        if self._released_since_drop:
            self._current_depth, self._released_since_drop = max(self._current_depth - 1, min(FEW, self._depth)), False
        most = self._current_depth - (self._span_of_parts > 0)
        while len(self._queue) > 1 and self.filled > most:
            oldest = self._queue.popleft()
            self._queue[0].restarted |= oldest.restarted  # kept, although the cloud that had it is dropped
            self._queue[0].stepped |= oldest.stepped
            self._queue[0].dropped += oldest.dropped + 1
            self.dropped += 1
