# SPDX-License-Identifier: Apache-2.0
"""Buffers IMU samples until the scan that they are associated with arrives."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import numpy as np

from dpm2_core.data.messages import MessageError
from dpm2_core.data.pairing import JUMP, SetBack
from dpm2_core.frame import Array, Inertial

KEPT = 11_000_000_000
"""ns before a scan in which samples are used: they give the rotation across a pause of up to 10 s."""
_MAX_VALUES = np.repeat([40.0, 300.0], 3)  # rad/s and m/s2: more than any commercial sensor measures
_MIN_PERIOD = 400_000  # ns: no IMU is faster than 2500 Hz
_MAX_SAMPLES = 10_000  # samples kept; bounds memory if no cloud arrives


def decode_imu(message: Any) -> tuple[Array, Array]:
    """Rates (3,) rad/s and forces (3,) m/s2 of a sensor_msgs/Imu; forces are NaN if it has none.

    Raises:
        MessageError: it has no rates, or impossible numbers.
    """
    rates, forces = message.angular_velocity, message.linear_acceleration
    values = np.array([rates.x, rates.y, rates.z, forces.x, forces.y, forces.z])
    if message.angular_velocity_covariance[0] == -1:
        raise MessageError("an IMU without angular velocities")
    if message.linear_acceleration_covariance[0] == -1 or not values[3:].any():
        values[3:] = np.nan  # as defined by REP-145; a gyroscope's driver may send zeros instead
    out_of_range = ~(np.abs(values) <= _MAX_VALUES)
    if out_of_range[:3].any() or (out_of_range[3:].any() and not np.isnan(values[3:]).all()):
        raise MessageError(f"angular velocity {values[:3].tolist()} rad/s, acceleration {values[3:].tolist()} m/s2")
    return values[:3], values[3:]


class ImuBuffer:
    """The latest samples in order of their stamps; thread-safe.

    Attributes:
        last: stamp of the newest sample, ns; -inf before the first. taken: the same, of those that were taken.
        frame: frame of the measurements.
    """

    def __init__(self) -> None:
        self.last = self.taken = -float("inf")
        self.frame = ""
        self._lock = threading.Lock()
        self._samples: deque[tuple[int, Array, Array]] = deque(maxlen=_MAX_SAMPLES)
        self._set_back = SetBack()

    def clear(self) -> None:
        """Remove all samples."""
        with self._lock:
            self.last = self.taken = -float("inf")
            self._samples.clear()

    def add(self, stamp: int, message: Any) -> None:
        """Add a sensor_msgs/Imu with its stamp (ns). A stamp that jumps by more than a second starts a new series, and
        so do the stamps of a clock that was set back by less.

        Raises:
            MessageError: see `decode_imu`; or the sample is not newer than the last one, or follows it too closely.
        """
        rates, forces = decode_imu(message)
        with self._lock:
            step, samples = stamp - self.last, [(stamp, rates, forces)]
            if -JUMP < step < _MIN_PERIOD:
                samples = self._set_back.add(stamp, samples[0]) if step < 0 else []
                if not samples:
                    raise MessageError(f"a sample {step * 1e-6:.3f} ms after the one before")
            self._set_back.end()
            if not 0 < step <= JUMP:
                self._samples.clear()
            self.last, self.frame = stamp, message.header.frame_id
            self._samples.extend(samples)

    def take(self, stamp: int, until: int) -> Inertial | None:
        """Samples up to `until` (ns) that were not taken before, for a scan with that stamp (ns); None if there are
        none within the last `KEPT`."""
        with self._lock:
            taken = []
            while self._samples and self._samples[0][0] <= until:
                taken.append(self._samples.popleft())
        taken = [sample for sample in taken if sample[0] > stamp - KEPT]
        if not taken:
            return None
        self.taken = taken[-1][0]
        stamps, rates, forces = zip(*taken, strict=True)
        return Inertial(np.array(stamps, np.int64), np.array(rates), np.array(forces))
