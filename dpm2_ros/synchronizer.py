# SPDX-License-Identifier: Apache-2.0
"""Which images go with which cloud, and when a cloud has waited long enough. Pure logic: no ROS, no clock, no thread.

The cloud leads: every accepted cloud leaves exactly once, in order, with the images that were there in time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

JUMP = 1.0
"""A stamp that goes back by more than this (s), or ahead by more than this beyond the time that has passed, jumps. It
may be wrong, or time itself has jumped: a looped bag, a clock that was set, a recording with a gap."""
HOLD = 0.5
"""Longest wait (s) for the next stamp, which tells."""
PATIENCE = 5
"""Clouds in a row that a camera may miss before nobody waits for it any more (until it delivers again)."""
BUFFER = 16
"""Images kept for a camera."""


class StampCheck(StrEnum):
    """What became of an incoming cloud."""

    ACCEPTED = "accepted"
    RESTARTED = "restarted"
    """Accepted, and time has gone back."""
    REPEATED = "repeated"
    """Rejected: its stamp is that of the cloud before."""
    OUT_OF_ORDER = "out of order"
    """Rejected: a later cloud has been accepted already."""
    JUMPED = "the stamp jumps; the next one tells whether it is true"
    """Neither accepted nor rejected yet; counted as what becomes of it."""
    STRAY = "stray"
    """Rejected: its stamp jumped, and the next one did not."""


@dataclass(eq=False)
class Bundle:
    """A cloud and its images (by camera number), ready to be processed; arrival and `now` are seconds of one clock."""

    stamp: int
    cloud: Any
    arrival: float
    restarted: bool
    images: dict[int, Any] = field(default_factory=dict)


@dataclass(eq=False)
class CameraState:
    """What one camera has delivered."""

    received: int = 0
    matched: int = 0
    late: int = 0
    """Images whose cloud had left without them."""
    missed: int = 0
    """Clouds in a row that left without its image."""
    last_arrival: float | None = None
    present: bool = True
    """Whether anybody is there who could deliver; nobody waits for a camera that is not."""
    images: deque[tuple[int, Any]] = field(default_factory=lambda: deque(maxlen=BUFFER))

    @property
    def awaited(self) -> bool:
        """Whether a cloud still waits for this camera."""
        return self.missed < PATIENCE


class Synchronizer:
    """A bounded queue of clouds, each waiting for its images.

    Args:
        cameras: how many there are; 0 never waits.
        depth: clouds that may wait; when full, the oldest is dropped.
        timeout: longest wait of a cloud for its images, s.
        tolerance: greatest difference of stamps that belong together, s.
    """

    def __init__(self, cameras: int, depth: int, timeout: float, tolerance: float) -> None:
        self.cameras = [CameraState() for _ in range(cameras)]
        self.counts: dict[StampCheck, int] = dict.fromkeys(StampCheck, 0)
        self.dropped = 0
        self.last_arrival: float | None = None
        self._timeout, self._tolerance = timeout, round(tolerance * 1e9)
        self._queue: deque[Bundle] = deque()
        self._depth = depth
        self._newest: int | None = None  # stamp of the last cloud accepted
        self._arrival = 0.0  # of that cloud
        self._jumped: Bundle | None = None
        self._left: Bundle | None = None  # the last cloud that went

    def __len__(self) -> int:
        """Clouds that are waiting."""
        return len(self._queue) + (self._jumped is not None)

    @property
    def received(self) -> int:
        """Clouds that have come in."""
        return sum(self.counts.values()) + (self._jumped is not None)

    def add_cloud(self, stamp: int, cloud: Any, now: float) -> StampCheck:
        """Take a cloud with its stamp (ns); `now` is when it arrived."""
        self.last_arrival = now
        if self._jumped is not None and self._newest is not None:
            self._settle(abs(stamp - self._jumped.stamp) <= abs(stamp - self._newest))
        check = self._check(stamp, now)
        if check is StampCheck.JUMPED:
            self._jumped = Bundle(stamp, cloud, now, restarted=False)
            return check
        self.counts[check] += 1
        if check is StampCheck.ACCEPTED:
            self._accept(Bundle(stamp, cloud, now, restarted=False))
        return check

    def due(self, stamp: int, now: float) -> bool:
        """Whether a cloud of that stamp (ns) would be accepted as the next one of the drive."""
        return self._newest is not None and self._check(stamp, now) is StampCheck.ACCEPTED

    def add_image(self, camera: int, stamp: int, image: Any, now: float) -> None:
        """Take an image of one camera with its stamp (ns)."""
        state = self.cameras[camera]
        state.received += 1
        state.last_arrival = now
        if state.images and stamp < state.images[-1][0] - JUMP * 1e9:
            state.images.clear()
        left = self._left
        gone = left is not None and -JUMP * 1e9 < stamp - left.stamp <= self._tolerance
        if left is not None and gone and (state.missed or stamp < left.stamp - self._tolerance):
            state.late += 1
            if now <= left.arrival + self._timeout:
                state.missed = 0  # it would have come in time, had that cloud waited
            return
        state.missed = 0
        state.images.append((stamp, image))

    def pop(self, now: float) -> Bundle | None:
        """The next cloud that has its images or has waited long enough; None if there is none yet."""
        if self._jumped is not None and now >= self._jumped.arrival + HOLD:
            self._settle(true=True)
        if not self._queue:
            return None
        head = self._queue[0]
        found = [self._match(state, head.stamp) for state in self.cameras]
        pending = any(
            match is None and state.present and state.awaited and not self._passed(state, head.stamp)
            for match, state in zip(found, self.cameras, strict=True)
        )
        if pending and now < head.arrival + self._timeout:
            return None
        self._queue.popleft()
        for camera, (match, state) in enumerate(zip(found, self.cameras, strict=True)):
            if match is None:
                state.missed += 1
            else:
                state.matched += 1
                head.images[camera] = match[1]
            self._forget(state, head.stamp)
        self._left = Bundle(head.stamp, None, head.arrival, head.restarted)
        return head

    def deadline(self) -> float | None:
        """When the next cloud will have waited long enough; None if none waits."""
        if self._queue:
            return self._queue[0].arrival + self._timeout
        return self._jumped.arrival + HOLD if self._jumped is not None else None

    def _check(self, stamp: int, now: float) -> StampCheck:
        if self._newest is None:
            return StampCheck.ACCEPTED
        step = (stamp - self._newest) * 1e-9
        if step < -JUMP or step > JUMP + now - self._arrival:
            return StampCheck.JUMPED
        if step > 0:
            return StampCheck.ACCEPTED
        return StampCheck.OUT_OF_ORDER if step else StampCheck.REPEATED

    def _settle(self, true: bool) -> None:
        """Accept or reject the cloud whose stamp jumped."""
        bundle, self._jumped = self._jumped, None
        if bundle is None or self._newest is None:
            return
        bundle.restarted = true and bundle.stamp < self._newest
        self.counts[
            StampCheck.RESTARTED if bundle.restarted else StampCheck.ACCEPTED if true else StampCheck.STRAY
        ] += 1
        if true:
            self._accept(bundle)

    def _accept(self, bundle: Bundle) -> None:
        self._newest, self._arrival = bundle.stamp, bundle.arrival
        self._queue.append(bundle)
        if len(self._queue) > self._depth:
            oldest = self._queue.popleft()
            self._queue[0].restarted |= oldest.restarted  # not lost with the cloud that announced it
            self.dropped += 1

    def _match(self, state: CameraState, stamp: int) -> tuple[int, Any] | None:
        nearest = min(state.images, key=lambda image: abs(image[0] - stamp), default=None)
        return nearest if nearest is not None and abs(nearest[0] - stamp) <= self._tolerance else None

    def _passed(self, state: CameraState, stamp: int) -> bool:
        """Whether the camera is already beyond this cloud, so that waiting is useless."""
        return bool(state.images) and stamp + self._tolerance < state.images[-1][0] < stamp + JUMP * 1e9

    def _forget(self, state: CameraState, stamp: int) -> None:
        """Images too old for the next cloud, or left over from before a restart."""
        while state.images and not 0 <= state.images[0][0] - stamp + self._tolerance < JUMP * 1e9:
            state.images.popleft()
