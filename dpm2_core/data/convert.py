# SPDX-License-Identifier: Apache-2.0
"""Converts any recording to a rosbag2 MCAP recording, readable by `ros2 bag play`, Foxglove and dpm2."""

from __future__ import annotations

import os
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dpm2_core.console import Advance, untold
from dpm2_core.data import bag_messages, naming
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.pairing import SWEEP
from dpm2_core.data.point_times import last_point
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import Source, Span
from dpm2_core.errors import UsageError
from dpm2_core.files import new_folder
from dpm2_core.frame import Array, Frame, Image, Inertial
from dpm2_core.geometry import se3

EPOCH_NS = 1_316_995_200_000_000_000
"""Added to stamps that are no times since 1970, such as KITTI's: 26 September 2011, its first day. ROS takes a stamp
near 0 for a missing one."""
_MIN_EPOCH_STAMP = 10**17  # ns, in 1973
_PERIOD = 100_000_000  # ns, between the two clouds before and after the clock was set

# The odometry data set has no such calibration: kitti2bag's base_link, at mid-wheelbase and ground level.
_T_BASE_LIDAR = se3.make(np.eye(3), [-0.59, 0.0, 1.73])


def convert(
    source: Source,
    out: Path,
    frames: Span = (0, None),
    zstd: bool = False,
    overwrite: bool = False,
    progress: Advance = untold,
) -> list[str]:
    """Write frames of a drive to the new folder `out`, which appears complete or not at all.

    KITTI odometry is written with the topics and frames of kitti2bag, which are the nodes' defaults. Its points are
    written unchanged; the vertical angle correction that they need is recorded on its own topic. Other drives have the
    names in `naming.OTHER`.

    Args:
        source: drive to convert, with its images, as rgb8.
        frames: position of the first frame, and of the one after the last.
        zstd: compress the chunks of the file.
        overwrite: replace a bag at `out`.
        progress: called with the number of frames written and the total.

    Returns:
        Notes for the user, in words.

    Raises:
        UsageError: no such frames, or `out` exists and may not be replaced.
        Dpm2Error: it could not be written (disk full); nothing incomplete remains.
    """
    start, end = frames
    positions = range(len(source))[start:end]
    if not positions:
        raise UsageError(f"{source.name}: no frames {start}:{'' if end is None else end}; it has {len(source)}")
    _check_destination(out.resolve(), overwrite)
    with new_folder(out, replace=True) as part:
        folder = part / out.resolve().name  # the file in a recording is named after the folder
        writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        if zstd:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            bag = _BagWriter(writer, source)
            for done, frame in enumerate(prefetch(bag.source.frames(positions.start, positions.stop))):
                bag.write(frame, positions[done])
                progress(done + 1, len(positions))
            bag.write_path()
        for path in folder.iterdir():
            with path.open("rb") as file:
                os.fsync(file.fileno())
            path.rename(part / path.name)
        folder.rmdir()
    return source.notes


class _BagWriter:
    """The topics of one recording."""

    def __init__(self, writer: Writer, source: Source) -> None:
        self._writer, self.source = writer, source
        self._connections: dict[str, Any] = {}
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._first_stamp: int | None = None  # ns
        self._last_cloud_time = 0  # ns, time of recording of the last cloud, if recorded at its stamp
        self._stamp_shift = self._log_shift = 0  # ns: added to stamps; and added to times of recording in addition
        self._last_recorded: dict[str, int] = {}  # ns, time of recording of the last message of each topic
        self._names = naming.OTHER
        self._correction_deg: float | None = None
        self._links: dict[str, tuple[str, Array]] = {}  # frame to its parent and T_parent_frame
        camera = getattr(source, "camera", None)  # stays the first one even if its images start late
        self._cameras: list[str] = [] if camera is None else [camera.name]
        self._path: list[tuple[int, Array]] = []
        self._R_lidar_imu = np.eye(3)
        T_base_lidar = getattr(source, "T_base_lidar", None)
        if isinstance(source, KittiSource):
            self.source = copy(source)
            self.source.vertical_angle_correction_deg = 0.0  # recorded here, applied by the reader
            self._names, self._correction_deg = naming.KITTI, source.vertical_angle_correction_deg
            self._R_lidar_imu = source.R_lidar_imu
            T_base_lidar = _T_BASE_LIDAR
        if T_base_lidar is not None:
            self._links[self._names.lidar] = (naming.BASE, T_base_lidar)
        if source.T_cam_lidar is not None:
            self._links[naming.GRAY_CAMERA] = (self._names.lidar, se3.inverse(source.T_cam_lidar))

    def write(self, frame: Frame, position: int) -> None:
        """Write a frame. IMU, fix and image come first, so that a reader has them when it receives the cloud. The cloud
        is recorded at the time of its last point, as drivers send it: the IMU samples of the sweep come before it."""
        stamp = self._begin_frame(frame)
        self._write_transforms(stamp, frame)
        if frame.imu is not None:
            self._write_imu(frame.imu)
        if frame.fix is not None and self._is_new(naming.FIX, time := frame.fix.stamp + self._stamp_shift):
            self._write_message(naming.FIX, time, bag_messages.nav_sat_fix(time, frame.fix))
        if frame.problem:
            self.source.notes.append(f"{frame.problem}: written as an empty cloud")
        for image in frame.images:
            self._write_image(image, stamp + round(image.time_offset * 1e9))
        T = None if self.source.poses is None else self.source.poses[position]
        if T is not None and np.isfinite(T).all():
            self._path.append((stamp, T))
            self._write_message(f"{self._names.truth}/odom", stamp, bag_messages.odometry(stamp, self._names.lidar, T))
        points, end = self._names.points, stamp + min(last_point(frame.time_offset), SWEEP)
        # Keeps the clouds' order, whatever the times are.
        end = max(end, self._last_recorded.get(points, end) - self._log_shift)
        self._write_message(points, end, bag_messages.cloud(stamp, self._names.lidar, frame))

    def write_path(self) -> None:
        """Write the path at the time of the first message, where players look for it."""
        if self._first_stamp is not None and self.source.poses is not None:
            path = bag_messages.path(self._first_stamp, self._path)
            self._write_message(f"{self._names.truth}/path", self._first_stamp, path, latched=True)

    def _begin_frame(self, frame: Frame) -> int:
        """The stamp to write, ns. Readers use the time of recording, which continues evenly where the clock was set."""
        # Per frame, since a clock may be set during a drive.
        self._stamp_shift = EPOCH_NS if frame.stamp < _MIN_EPOCH_STAMP else 0
        stamp = frame.stamp + self._stamp_shift
        if self._first_stamp is None:
            self._first_stamp = self._last_cloud_time = stamp
            if self._correction_deg is not None:
                correction = bag_messages.number(self._correction_deg)
                self._write_message(naming.VERTICAL_ANGLE_CORRECTION, stamp, correction, latched=True)
        if frame.stepped or stamp + self._log_shift < self._last_cloud_time:
            self._log_shift = self._last_cloud_time + _PERIOD - stamp
            if frame.imu and naming.IMU in self._last_recorded:  # the sweep may be longer than _PERIOD
                first = int(frame.imu.stamps[0]) + self._stamp_shift
                self._log_shift = max(self._log_shift, self._last_recorded[naming.IMU] + 1 - first)
        self._last_cloud_time = stamp + self._log_shift
        return stamp

    def _is_new(self, topic: str, stamp: int) -> bool:
        """Whether a message is newer than the last one on its topic: frames may share messages."""
        return topic not in self._last_recorded or stamp + self._log_shift > self._last_recorded[topic]

    def _write_transforms(self, stamp: int, frame: Frame) -> None:
        """Write all transforms again if there is a new one: late subscribers receive only the last message."""
        links, lidar = dict(self._links), self._names.lidar
        for image in frame.images:
            if image.camera.name not in self._cameras:
                self._cameras.append(image.camera.name)
            links[self._optical_frame(image)] = (lidar, image.camera.T_lidar_cam)
        if frame.imu is not None:
            links[naming.IMU_LINK] = (lidar, se3.make(self._R_lidar_imu, np.zeros(3)))
        if frame.fix is not None:
            links[naming.GNSS_LINK] = (lidar, se3.make(np.eye(3), frame.fix.antenna))
        if links and (links.keys() != self._links.keys() or naming.TF_STATIC not in self._connections):
            self._links = links
            self._write_message(naming.TF_STATIC, stamp, bag_messages.transforms(stamp, links), latched=True)

    def _camera_suffix(self, image: Image) -> str:
        """Suffix of the names of its camera."""
        number = self._cameras.index(image.camera.name)
        return f"_{number + 1}" if number else ""

    def _optical_frame(self, image: Image) -> str:
        return self._names.optical + self._camera_suffix(image)

    def _write_image(self, image: Image, stamp: int) -> None:
        frame, topic = self._optical_frame(image), self._names.camera + self._camera_suffix(image)
        if self._is_new(f"{topic}/image_raw", stamp):
            self._write_message(f"{topic}/camera_info", stamp, bag_messages.camera_info(stamp, frame, image.camera))
            self._write_message(f"{topic}/image_raw", stamp, bag_messages.image(stamp, frame, image.pixels))

    def _write_imu(self, imu: Inertial) -> None:
        R = self._R_lidar_imu  # rotates back into the IMU frame
        for time, rates, forces in zip(imu.stamps.tolist(), imu.rates @ R, imu.forces @ R, strict=True):
            if self._is_new(naming.IMU, time + self._stamp_shift):
                self._write_message(
                    naming.IMU, time + self._stamp_shift, bag_messages.imu(time + self._stamp_shift, rates, forces)
                )

    def _write_message(self, topic: str, stamp: int, msg: Any, latched: bool = False) -> None:
        kind = msg.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._typestore, offered_qos_profiles=[_qos(latched)]
            )
        self._last_recorded[topic] = stamp if latched else stamp + self._log_shift
        self._writer.write(
            self._connections[topic], self._last_recorded[topic], self._typestore.serialize_cdr(msg, kind)
        )


def _check_destination(out: Path, overwrite: bool) -> None:
    """Raise UsageError if no recording can be written to `out`, or if existing data there must not be replaced."""
    if out.suffix in (".mcap", ".db3", ".bag"):
        raise UsageError(f"{out}: a rosbag2 recording is a folder; leave out the {out.suffix}")
    if out.exists() and not (overwrite and (out / "metadata.yaml").is_file()):
        reason = "not a rosbag2 folder, so it is not overwritten" if overwrite else "use --overwrite to replace it"
        raise UsageError(f"{out}: exists already; {reason}")


def _qos(latched: bool) -> Qos:
    infinite = QosTime(9223372036, 854775807)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(QosHistory.KEEP_LAST, 1 if latched else 10, QosReliability.RELIABLE, durability, infinite, infinite,
               QosLiveliness.AUTOMATIC, infinite, False)  # fmt: skip
