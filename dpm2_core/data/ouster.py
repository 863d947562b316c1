# SPDX-License-Identifier: Apache-2.0
"""A recording of an Ouster LiDAR's network packets, as a `Source`: .pcap, or .osf of Ouster's own tools."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.frames import Calibration, FrameBuilder
from dpm2_core.data.imu import ImuBuffer
from dpm2_core.data.messages import MessageError, point_cloud
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.extras import MissingPackageError
from dpm2_core.frame import NO_POINTS, Array, Frame

# Its dependencies pin rosbags and others to releases that this package cannot use; for reading, none are needed.
INSTALL = "pip install --no-deps 'ouster-sdk>=1,<2'"
_RECEIVED_BIT = 1  # bit in a column's status
_FRAME = "os_sensor"  # frame of the housing
_MAX_SWEEP = 100_000_000  # ns, the longest sweep
_INTENSITY_FIELDS = ("REFLECTIVITY", "SIGNAL")  # the first one that the recording has


class OusterSource:
    """Sweeps in the frame of the sensor's housing, stamped at the time of their first column. See `Source`.

    Intensity is the reflectivity, and each column has its time. From a .pcap the sensor's IMU is read, too. A .pcap
    needs the sensor's metadata next to it: the .json whose name begins the same. There are no images or ground truth.

    Raises:
        UsageError: the file cannot be read, or it has several sensors and `input.points_topic` names none of them.
        MissingPackageError: ouster-sdk is not installed.
    """

    T_cam_lidar: Array | None = None
    poses: Array | None = None
    truth = ""

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        self.path, settings = Path(path), settings or InputSettings()
        self.name, self.notes = self.path.stem, list[str]()
        self._sensor, self._project, self._sweeps = _open_sensor(self.path, settings.points_topic)
        # An .osf has an index; if one is missing, the package would write it into the file.
        self._count = len(self._sweeps) if self._sweeps.is_indexed else sum(1 for _ in self._sweeps)
        if not self._count:
            raise UsageError(f"{self.path}: no sweep of the sensor that its metadata describes")
        self._imu, self._has_imu = ImuBuffer(), settings.imu and self.path.suffix == ".pcap"
        calibration = Calibration(self.path.name, imu_topic="IMU")
        self._frames = FrameBuilder(settings, calibration, self.notes.append, imu=self._imu)

    def __len__(self) -> int:
        return self._count

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 by position; the first unreadable one has `problem` set and is the last."""
        indices, stamp = range(*slice(start, stop).indices(self._count)), 0
        # With its index, the package (1.0) finds the first sweep of an .osf in place of its last.
        upcoming = islice(self._sweeps, indices.start, indices.stop)
        samples = _imu_samples(self.path, self._sensor) if self._has_imu else iter(())
        self._imu.clear()
        for index in indices:
            try:
                if (sweep := next(upcoming, None)) is None:
                    raise UsageError("its data are not there")
                columns, stamp = self._columns(sweep[0], stamp)
                self._add_imu_samples(samples, stamp + _MAX_SWEEP)
            except Exception as error:  # the package raises several error types of its own for damaged files
                problem = f"{self.path}: sweep {index}: {_reason(error)}"
                self.notes.append(problem)
                yield Frame(stamp, NO_POINTS, index=index, problem=problem)
                return
            yield self._frames.frame(stamp, point_cloud(columns, stamp, _FRAME), index)

    def _add_imu_samples(self, samples: Iterator[tuple[int, Any]], until: int) -> None:
        """Add samples of the IMU up to the first one after a time, ns."""
        try:
            for stamp, message in samples:
                with suppress(MessageError):  # an impossible sample, or one that is not newer than the last
                    self._imu.add(stamp, message)
                if stamp > until:
                    break
        except Exception as error:  # as below
            self.notes.append(f"{self.path}: going on without the IMU: {_reason(error)}")

    def _columns(self, sweep: Any, last_stamp: int) -> tuple[dict[str, NDArray[Any]], int]:
        """PointCloud2 fields of the returned points, and the stamp, ns; `last_stamp` if no column was received."""
        received = (sweep.status & _RECEIVED_BIT).astype(bool)
        times = sweep.timestamp.astype(np.int64)
        stamp = int(times[received][0]) if received.any() else last_stamp
        ranges = sweep.field("RANGE")
        returned = (ranges > 0) & received
        xyz = self._project(ranges)[returned].astype(np.float32)
        columns: dict[str, NDArray[Any]] = {axis: xyz[:, i] for i, axis in enumerate("xyz")}
        columns["time_ns"] = np.broadcast_to((times - stamp).astype(np.float64), ranges.shape)[returned]
        intensity_field = next((name for name in _INTENSITY_FIELDS if sweep.has_field(name)), None)
        if intensity_field is not None:
            columns["intensity"] = sweep.field(intensity_field)[returned]
        return columns, stamp


def _imu_samples(path: Path, sensor: int) -> Iterator[tuple[int, Any]]:
    """Stamp, ns, and sensor_msgs/Imu along the axes of the housing, for each sample of a sensor's IMU."""
    from ouster.sdk import core, open_packet_source

    packets = open_packet_source(str(path))
    R = packets.sensor_info[sensor].imu_to_sensor_transform[:3, :3]
    header, no_covariance = SimpleNamespace(frame_id=_FRAME), np.zeros(9)  # covariances
    for index, packet in packets:
        if index == sensor and isinstance(packet, core.ImuPacket):
            rates, forces = np.reshape(packet.gyro(), (-1, 3)) @ R.T, np.reshape(packet.accel(), (-1, 3)) @ R.T
            for stamp, rate, force in zip(np.ravel(packet.timestamp()).tolist(), rates, forces, strict=True):
                rate, force = (SimpleNamespace(**dict(zip("xyz", xyz, strict=True))) for xyz in (rate, force))
                yield stamp, SimpleNamespace(
                    header=header, angular_velocity=rate, linear_acceleration=force,
                    angular_velocity_covariance=no_covariance, linear_acceleration_covariance=no_covariance,
                )  # fmt: skip


def _open_sensor(path: Path, sensor: str) -> tuple[int, Callable[[NDArray[Any]], Array], Any]:
    """The sensor with that serial number, or the only one: its position in the file, the function from ranges (H, W) to
    points (H, W, 3) m, and its sweeps."""
    try:
        from ouster.sdk import core, open_source
    except ModuleNotFoundError as error:
        raise MissingPackageError(f"reading {path} needs the package {error.name}: {INSTALL}") from None
    try:
        core.init_logger("error")
        sensors = [str(info.sn) for info in open_source(str(path)).sensor_info]
        if len(sensors) > 1 and sensor not in sensors:
            named = f"input.points_topic={sensor}" if sensor else "input.points_topic is empty"
            raise UsageError(f"{path}: {named}, want one of its sensors: {', '.join(sensors)}")
        chosen = sensors.index(sensor) if sensor in sensors else 0
        sweeps = open_source(str(path), collate=False, sensor_idx=chosen, index=path.suffix == ".pcap")
        return chosen, core.XYZLut(sweeps.sensor_info[0]), sweeps
    except UsageError:
        raise
    except Exception as error:  # of the package, whose error types have no common base
        raise UsageError(f"{path}: cannot be read as a recording of an Ouster: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """The last sentence of one of the package's errors; the first ones only repeat the request."""
    return " ".join(str(error).rpartition("more details:")[2].split())[:200] or type(error).__name__
