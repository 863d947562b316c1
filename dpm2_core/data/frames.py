# SPDX-License-Identifier: Apache-2.0
"""Builds a `Frame` from associated messages. Unusable data is reported once, and never replaced by a guess."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.gnss import FixBuffer
from dpm2_core.data.image_messages import decode_camera, decode_image, is_fisheye, rectified
from dpm2_core.data.imu import ImuBuffer
from dpm2_core.data.messages import MessageError, decode_points, returned, why_untimed
from dpm2_core.data.naming import frame_name
from dpm2_core.data.pairing import JUMP
from dpm2_core.data.point_times import last_point
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.sweep_parts import MAX_PERIOD
from dpm2_core.data.transforms import TransformTree
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle
from dpm2_core.errors import UsageError, printable
from dpm2_core.frame import NO_POINTS, Array, Camera, Fix, Frame, Image, Inertial, Points, Up
from dpm2_core.geometry import se3

_MAX_REPORTS = 20  # damaged data may produce any number of different messages
_MAX_PROBLEM_LENGTH = 300  # characters of a problem, whatever is in the message
_MAX_IMU_PERIOD = 50_000_000  # ns: an IMU whose samples are further apart has stopped
_MAX_SILENCE = 2_000_000_000  # ns, by the stamps: after a silence of this length another sensor may use the topic


@dataclass(eq=False)
class CameraTopic:
    """A camera by its messages: the full topic of its images, and the CameraInfo of these images (`info_of`), None
    until there is one."""

    topic: str
    info: Any = None


@dataclass(eq=False)
class Calibration:
    """What is known about the sensors: for a recording from the start, for live topics as messages arrive.

    Attributes:
        points_topic, second_topic, imu_topic, gnss_topic: full names; empty if there is none.
        camera, second_camera: None if there is none, or it is not used.
        lidar_frame: frame of the drive's clouds; a cloud in another frame cannot be used. Empty: any frame.
        transforms: from /tf_static.
        angle_correction_deg: vertical angle correction from the recording; None if it has none.
        heard: for each topic of a sensor other than the LiDAR: its frame, and the stamp (ns) of its last message.
    """

    points_topic: str
    second_topic: str = ""
    imu_topic: str = ""
    gnss_topic: str = ""
    camera: CameraTopic | None = None
    second_camera: CameraTopic | None = None
    lidar_frame: str = ""
    transforms: TransformTree = field(default_factory=TransformTree)
    angle_correction_deg: float | None = None
    heard: dict[str, tuple[str, int]] = field(default_factory=dict)

    def check_sensor(self, topic: str, frame: str, stamp: int) -> None:
        """Record the frame and stamp (ns) of a message; on each topic, the sensor that was received first counts.

        Raises:
            MessageError: the message is from another sensor, as when drivers are remapped to one topic. Two IMUs would
                look like one that rotates, two cameras like one that jumps. A message without a frame is accepted.
        """
        known, last = self.heard.get(topic, ("", stamp))
        frame = frame_name(frame) or known
        if known and frame != known and abs(stamp - last) < _MAX_SILENCE:
            found = f"a message in frame {frame[:80]!r}, the previous ones are in {known!r}"
            raise MessageError(f"{found}: a topic has one sensor")
        self.heard[topic] = frame, stamp

    def frame_of(self, camera: CameraTopic) -> str:
        """The frame of a camera's images; empty if it is not known yet, or the images name none."""
        return self.heard.get(camera.topic, ("", 0))[0]

    @property
    def cameras(self) -> list[CameraTopic]:
        """The cameras that exist, the first one first."""
        return [camera for camera in (self.camera, self.second_camera) if camera is not None]


class FrameBuilder:
    """Builds frames from messages.

    Args:
        settings: how to read the messages.
        calibration: read again for each frame.
        on_problem: called once for each different problem.
        decode: deserializes a message of a topic, or raises MessageError; the default takes messages as they are.
        imu, gnss: buffers of their messages; None if the sensor is not used.

    Attributes:
        up: `up` of each `Frame`, and of its `Inertial`.
        problems: topic of a sensor other than the LiDAR to why its last message could not be used, if so.
        time_problem: why the last cloud cannot be de-skewed; empty if it can be, or need not be.
    """

    def __init__(
        self,
        settings: InputSettings,
        calibration: Calibration,
        on_problem: Callable[[str], None],
        decode: Callable[[str, Any], Any] = lambda topic, message: message,
        imu: ImuBuffer | None = None,
        gnss: FixBuffer | None = None,
    ) -> None:
        self._settings, self._calibration, self._on_problem, self._decode = settings, calibration, on_problem, decode
        self._reported: set[str] = set()
        self.problems: dict[str, str] = {}
        self.time_problem = ""
        self._imu, self._gnss = imu, gnss
        # By topic: the last image message, the info that it was decoded with, its frame and its pixels. One image is
        # associated with several clouds if these are parts of a sweep.
        self._last_decoded: dict[str, tuple[Any, Any, str, NDArray[np.uint8]]] = {}
        self._last_stamp: int | None = None  # of the last cloud
        self._last_merged: Any = None  # the last message of a second LiDAR whose points a cloud got
        self.up: Up | None = (0.0, 0.0, 1.0)

    def frame(self, stamp: int, cloud: Any, index: int, messages: Mapping[str, tuple[int, Any]] | None = None) -> Frame:
        """The frame of a cloud with its stamp (ns) and the associated messages; `problem` is set if it is unreadable.

        Args:
            messages: stamp (ns) and message of each camera and of a second LiDAR, by topic, if available.
        """
        messages, topic = messages or {}, self._calibration.points_topic
        try:
            cloud = self._decode(topic, cloud)
            self._check_frame(cloud.header.frame_id)
            points, offset = self._points(cloud)
        except MessageError as error:
            problem = self._report(topic, error)
            return Frame(stamp, NO_POINTS, index=index, up=self.up, problem=problem)
        unexpected = offset is None and self._settings.time_field is None and not topic.startswith("/kitti/")
        # A single point, as of a part of a sweep that shows the sky, has no span: it says nothing about the times.
        wrong = unexpected and np.count_nonzero(returned(points)) > 1
        self.time_problem = f"{why_untimed(cloud)}: not de-skewed" if wrong else ""
        points = correct_vertical_angle(points, self.angle_correction_deg)
        lidar_frame = cloud.header.frame_id
        second = messages.get(self._calibration.second_topic)
        if second is not None and self._is_nearest(stamp, *second):
            self._last_merged = second[1]
            points, offset = self._merged(points, offset, lidar_frame, (second[0] - stamp) * 1e-9, second[1])
        self._last_stamp = stamp
        imu = None if self._imu is None else self._imu_samples(self._imu, lidar_frame, stamp, offset)
        fix = None if self._gnss is None else self._fix(self._gnss, lidar_frame, stamp)
        associated = [
            (camera, *messages[camera.topic]) for camera in self._calibration.cameras if camera.topic in messages
        ]
        found = (self._image(lidar_frame, camera, message, (at - stamp) * 1e-9) for camera, at, message in associated)
        images = tuple(image for image in found if image is not None)
        return Frame(stamp, points, offset, images, index, up=self.up, imu=imu, fix=fix)

    def _check_frame(self, frame: str) -> None:
        """Raise MessageError for a cloud of another LiDAR: poses of two LiDARs would look like the motion of one."""
        drive_frame = self._calibration.lidar_frame
        if drive_frame and frame_name(frame) != frame_name(drive_frame):
            found = f"a cloud in frame {frame[:80]!r}, the drive's are in {drive_frame!r}"
            raise MessageError(f"{found}: one drive has one LiDAR")

    def _points(self, cloud: Any) -> tuple[Points, Points | None]:
        """Points (N, 4) and their times (N,), s after the stamp, of a decoded message."""
        settings = self._settings
        return decode_points(cloud, settings.time_field, settings.time_unit, settings.intensity_max)

    def _is_nearest(self, stamp: int, second_stamp: int, second: Any) -> bool:
        """Whether the cloud of a second LiDAR is to be merged into this one; stamps in ns. Of parts of a sweep that it
        is associated with, only the nearest one gets its points."""
        period = MAX_PERIOD if self._last_stamp is None else abs(stamp - self._last_stamp) * 1e-9
        if not 0 < period < MAX_PERIOD:
            return True
        return second is not self._last_merged and (second_stamp - stamp) * 1e-9 <= period / 2

    def _merged(
        self, points: Points, offset: Points | None, lidar_frame: str, delay: float, second: Any
    ) -> tuple[Points, Points | None]:
        """Points (N, 4) and times (N,) merged with those of a second LiDAR, stamped `delay` s after the first."""
        topic = self._calibration.second_topic
        with self._report_errors(topic, "going on without the second LiDAR"):
            second = self._decode(topic, second)
            others, other_offset = self._points(second)
            T = self._calibration.transforms.between(lidar_frame, second.header.frame_id)
            seen = returned(others)  # once transformed, the zeros of a missing return would look like a point
            others, other_offset = others[seen], None if other_offset is None else other_offset[seen]
            if offset is not None or other_offset is not None or delay:
                first_times = np.zeros(len(points), np.float32) if offset is None else offset
                second_times = np.zeros(len(others), np.float32) if other_offset is None else other_offset
                offset = np.concatenate([first_times, second_times + np.float32(delay)])
            return np.concatenate([points, se3.transform(T, others)]), offset
        return points, offset

    def camera(self, camera: CameraTopic, lidar_frame: str, image_frame: str) -> Camera:
        """A camera from current calibration, named by its topic; `image_frame` is used if its CameraInfo has no frame.

        Raises:
            UsageError: CameraInfo or extrinsics are missing or unusable.
        """
        first, T_lidar_cam = self._calibration.camera, None
        if camera.info is None:
            raise UsageError("no CameraInfo yet")
        frame, hint = camera.info.header.frame_id or image_frame, "publish it on /tf_static"
        if camera is first:
            T_lidar_cam = self._settings.extrinsic()
            hint = "set input.T_lidar_cam, publish it on /tf_static, or leave images out with input.images=false"
        elif first is not None and first.info is not None and frame == first.info.header.frame_id:
            raise UsageError(f"its frame {frame!r} is that of {first.topic}: two cameras are not in one place")
        if T_lidar_cam is None:
            try:
                T_lidar_cam = self._calibration.transforms.lookup(lidar_frame, frame)
            except UsageError as error:
                raise UsageError(f"{error}; {hint}") from None
        return decode_camera(camera.info, T_lidar_cam, camera.topic)

    @property
    def angle_correction_deg(self) -> float:
        """Degrees added to each elevation: the value set, else the recording's value, else KITTI's for KITTI topics."""
        recorded = self._calibration.angle_correction_deg
        default = HDL64_CORRECTION_DEG if self._calibration.points_topic.startswith("/kitti/") else 0.0
        return self._settings.angle_correction(default if recorded is None else recorded)

    def _imu_samples(self, buffer: ImuBuffer, lidar_frame: str, stamp: int, offset: Points | None) -> Inertial | None:
        """The samples up to the last point of a scan, rotated into the LiDAR frame."""
        if buffer.last == -float("inf"):
            return None
        found = buffer.take(stamp, stamp + last_point(offset))
        if found is None and -JUMP < stamp - buffer.taken < _MAX_IMU_PERIOD:  # a part of a sweep, between two samples
            return None
        with self._report_errors(self._calibration.imu_topic, "going on without the IMU"):
            if found is None:
                raise UsageError("no samples at the time of the scan")
            if not found.rates.any() and np.isnan(found.forces).all():  # no real gyroscope measures exactly 0
                raise UsageError("its rates and forces are all 0: it measures neither")
            R = self._imu_rotation(lidar_frame, buffer.frame)
            return replace(found, rates=found.rates @ R.T, forces=found.forces @ R.T, up=self.up)
        return None

    def _imu_rotation(self, lidar_frame: str, imu_frame: str) -> Array:
        """R_lidar_imu (3, 3)."""
        R = self._settings.imu_rotation()
        if R is not None:
            return R
        try:
            return self._calibration.transforms.between(lidar_frame, imu_frame)[:3, :3]
        except UsageError as error:
            raise UsageError(f"{error}; set input.q_lidar_imu, or publish it on /tf_static") from None

    def _fix(self, buffer: FixBuffer, lidar_frame: str, stamp: int) -> Fix | None:
        """The last fix before a scan, with the position of its antenna."""
        if (fix := buffer.take(stamp)) is None:
            return None
        with self._report_errors(self._calibration.gnss_topic, "the antenna is assumed to be at the LiDAR"):
            if frame_name(buffer.frame) != frame_name(lidar_frame):
                fix = replace(fix, antenna=self._calibration.transforms.lookup(lidar_frame, buffer.frame)[:3, 3])
        return fix

    def _image(self, lidar_frame: str, camera_topic: CameraTopic, message: Any, delay: float) -> Image | None:
        with self._report_errors(camera_topic.topic, "images are left out"):
            cached = self._last_decoded.pop(camera_topic.topic, None)
            if cached is not None and cached[0] is message and cached[1] is camera_topic.info:
                frame, pixels = cached[2:]
                camera = self.camera(camera_topic, lidar_frame, frame)
            else:
                decoded = self._decode(camera_topic.topic, message)
                frame = decoded.header.frame_id
                camera = self.camera(camera_topic, lidar_frame, frame)
                pixels = decode_image(decoded, camera.size)
                if is_fisheye(camera_topic.info) and pixels.shape[1::-1] == camera.size:
                    pixels = rectified(pixels, camera_topic.info)
            self._last_decoded[camera_topic.topic] = message, camera_topic.info, frame, pixels
            return Image(pixels, camera, delay)
        return None

    @contextmanager
    def _report_errors(self, topic: str, consequence: str) -> Iterator[None]:
        """Guards the reading of a sensor other than the LiDAR; an error is stored as its problem, and reported."""
        try:
            yield
        except (UsageError, ValueError) as error:
            self.problems[topic] = self._report(topic, error, f"; {consequence}")
        else:
            self.problems.pop(topic, None)

    def _report(self, topic: str, error: Exception, suffix: str = "") -> str:
        """Report a problem unless it was reported already; returns it as one line."""
        problem = printable(str(error)[:_MAX_PROBLEM_LENGTH])
        text = f"{topic}: {problem.removeprefix(f'{topic}: ')}{suffix}"  # errors of damaged messages name the topic too
        if text not in self._reported and len(self._reported) < _MAX_REPORTS:
            self._reported.add(text)
            self._on_problem(text)
        return problem
