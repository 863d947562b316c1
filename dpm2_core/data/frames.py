# SPDX-License-Identifier: Apache-2.0
"""From messages that belong together to a `Frame`. What cannot be used is reported once, never replaced by a guess."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dpm2_core.data.gnss import FixBuffer
from dpm2_core.data.image_messages import decode_camera, decode_image, is_fisheye, rectified
from dpm2_core.data.imu import ImuBuffer
from dpm2_core.data.messages import MessageError, decode_points, returned, why_untimed
from dpm2_core.data.naming import frame_name
from dpm2_core.data.point_times import last_point
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.transforms import TransformTree
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle
from dpm2_core.errors import UsageError, printable
from dpm2_core.frame import NO_POINTS, Array, Camera, Fix, Frame, Image, Inertial, Points, Up
from dpm2_core.geometry import se3

_MOST_REPORTED = 20  # damaged data may be damaged in endless ways
_LENGTH = 300  # characters of a problem, whatever is in the message
_SILENT = 2_000_000_000  # ns by its stamps after which another sensor may take the place of one


@dataclass(eq=False)
class CameraTopic:
    """A camera by its messages: the full topic of its images, and what its CameraInfo says of them (`info_of`), None as
    long as there is none."""

    topic: str
    info: Any = None


@dataclass(eq=False)
class Calibration:
    """What is known of the sensors: of a recording from the start, of topics as it comes in.

    Attributes:
        points_topic, second_topic, imu_topic, gnss_topic: full names; empty where there is none.
        camera, second_camera: None where there is none, or none is wanted.
        lidar_frame: that of the drive's clouds: one in another frame cannot be used. Empty: any can.
        transforms: of /tf_static.
        angle_correction_deg: what the recording says of its vertical angles; None if it says nothing.
        heard: topic of a sensor beside the LiDAR to its frame, and the stamp (ns) of its last message.
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
        """Take note of a message with its frame and stamp (ns); on each topic the sensor that was heard first counts.

        Raises:
            MessageError: it is of another one, as where drivers are remapped to one topic: two IMUs would be taken for
                one that turns, two cameras for one that jumps. One that names no frame may be of any.
        """
        known, last = self.heard.get(topic, ("", stamp))
        frame = frame_name(frame) or known
        if known and frame != known and abs(stamp - last) < _SILENT:
            found = f"a message in frame {frame[:80]!r}, those before are in {known!r}"
            raise MessageError(f"{found}: a topic has one sensor")
        self.heard[topic] = frame, stamp

    def frame_of(self, camera: CameraTopic) -> str:
        """The frame of a camera's images; empty where it is not known yet, or they name none."""
        return self.heard.get(camera.topic, ("", 0))[0]

    @property
    def cameras(self) -> list[CameraTopic]:
        """Those that there are, the first one first."""
        return [camera for camera in (self.camera, self.second_camera) if camera is not None]


class FrameBuilder:
    """Makes frames of messages.

    Args:
        settings: how to read the messages.
        calibration: looked at anew for each frame.
        complain: called once with each different problem.
        decode: makes a message of a topic's bytes, or raises MessageError; the default takes messages as they are.
        imu, gnss: where their messages come in; None where none are wanted.

    Attributes:
        up: that of each `Frame`, and of its `Inertial`.
        problems: topic of a sensor beside the LiDAR to why its last message could not be used; only where that is so.
        time_problem: why the last cloud cannot be de-skewed; empty if it can, or needs not.
    """

    def __init__(
        self,
        settings: InputSettings,
        calibration: Calibration,
        complain: Callable[[str], None],
        decode: Callable[[str, Any], Any] = lambda topic, message: message,
        imu: ImuBuffer | None = None,
        gnss: FixBuffer | None = None,
    ) -> None:
        self._settings, self._calibration, self._complain, self._decode = settings, calibration, complain, decode
        self._told: set[str] = set()
        self.problems: dict[str, str] = {}
        self.time_problem = ""
        self._imu, self._gnss = imu, gnss
        self.up: Up | None = (0.0, 0.0, 1.0)

    def frame(self, stamp: int, cloud: Any, index: int, beside: Mapping[str, tuple[int, Any]] | None = None) -> Frame:
        """A cloud with its stamp (ns), and what goes with it; an unreadable cloud comes with `problem` set.

        Args:
            beside: stamp (ns) and message of each camera, and of a second LiDAR, by its topic; where there is one.
        """
        beside, topic = beside or {}, self._calibration.points_topic
        try:
            cloud = self._decode(topic, cloud)
            self._check_frame(cloud.header.frame_id)
            points, offset = self._points(cloud)
        except MessageError as error:
            problem = self._tell(topic, error)
            return Frame(stamp, NO_POINTS, index=index, up=self.up, problem=problem)
        expected = self._settings.time_field is None and not topic.startswith("/kitti/") and len(points)
        self.time_problem = f"{why_untimed(cloud)}: not de-skewed" if offset is None and expected else ""
        points = correct_vertical_angle(points, self.angle_correction_deg)
        lidar_frame = cloud.header.frame_id
        if (second := beside.get(self._calibration.second_topic)) is not None:
            points, offset = self._joined(points, offset, lidar_frame, (second[0] - stamp) * 1e-9, second[1])
        imu = None if self._imu is None else self._inertial(self._imu, lidar_frame, stamp, offset)
        fix = None if self._gnss is None else self._fix(self._gnss, lidar_frame, stamp)
        taken = [(camera, *beside[camera.topic]) for camera in self._calibration.cameras if camera.topic in beside]
        found = (self._image(lidar_frame, camera, message, (at - stamp) * 1e-9) for camera, at, message in taken)
        images = tuple(image for image in found if image is not None)
        return Frame(stamp, points, offset, images, index, up=self.up, imu=imu, fix=fix)

    def _check_frame(self, frame: str) -> None:
        """Raises MessageError for that of another LiDAR: poses of two would be taken for the motion of one."""
        of_drive = self._calibration.lidar_frame
        if of_drive and frame_name(frame) != frame_name(of_drive):
            found = f"a cloud in frame {frame[:80]!r}, the drive's are in {of_drive!r}"
            raise MessageError(f"{found}: one drive has one LiDAR")

    def _points(self, cloud: Any) -> tuple[Points, Points | None]:
        """(N, 4), and (N,) s after the stamp, of a decoded message."""
        settings = self._settings
        return decode_points(cloud, settings.time_field, settings.time_unit, settings.intensity_max)

    def _joined(
        self, points: Points, offset: Points | None, lidar_frame: str, late: float, second: Any
    ) -> tuple[Points, Points | None]:
        """Points (N, 4) with those that a second LiDAR has measured, `late` s after them; their times (N,) with its."""
        topic = self._calibration.second_topic
        with self._or_else(topic, "going on without the second LiDAR"):
            second = self._decode(topic, second)
            others, other_offset = self._points(second)
            T = self._calibration.transforms.between(lidar_frame, second.header.frame_id)
            seen = returned(others)  # moved, the zeros of a missing return would be a point
            others, other_offset = others[seen], None if other_offset is None else other_offset[seen]
            if offset is not None or other_offset is not None or late:
                first = np.zeros(len(points), np.float32) if offset is None else offset
                then = np.zeros(len(others), np.float32) if other_offset is None else other_offset
                offset = np.concatenate([first, then + np.float32(late)])
            return np.concatenate([points, se3.transform(T, others)]), offset
        return points, offset

    def camera(self, camera: CameraTopic, lidar_frame: str, image_frame: str) -> Camera:
        """A camera by what is known now, named by its topic; `image_frame` counts where its CameraInfo names no frame.

        Raises:
            UsageError: CameraInfo or extrinsics are missing, or cannot be used.
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
        """Added to the elevation of each point: what is set, else what the recording says, else KITTI's for KITTI."""
        known = self._calibration.angle_correction_deg
        usual = HDL64_CORRECTION_DEG if self._calibration.points_topic.startswith("/kitti/") else 0.0
        return self._settings.angle_correction(usual if known is None else known)

    def _inertial(self, buffer: ImuBuffer, lidar_frame: str, stamp: int, offset: Points | None) -> Inertial | None:
        """The samples up to the last point of a scan, along the LiDAR's axes."""
        if buffer.last == -float("inf"):
            return None
        found = buffer.take(stamp, stamp + last_point(offset))
        with self._or_else(self._calibration.imu_topic, "going on without the IMU"):
            if found is None:
                raise UsageError("no samples at the time of the scan")
            if not found.rates.any() and np.isnan(found.forces).all():  # no gyroscope is so still
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
        """The last fix before a scan, with the place of its antenna."""
        if (fix := buffer.take(stamp)) is None:
            return None
        with self._or_else(self._calibration.gnss_topic, "the antenna is taken for the LiDAR"):
            if frame_name(buffer.frame) != frame_name(lidar_frame):
                fix = replace(fix, antenna=self._calibration.transforms.lookup(lidar_frame, buffer.frame)[:3, 3])
        return fix

    def _image(self, lidar_frame: str, taken_by: CameraTopic, message: Any, late: float) -> Image | None:
        with self._or_else(taken_by.topic, "images are left out"):
            message = self._decode(taken_by.topic, message)
            camera = self.camera(taken_by, lidar_frame, message.header.frame_id)
            pixels = decode_image(message, camera.size)
            if is_fisheye(taken_by.info) and pixels.shape[1::-1] == camera.size:
                pixels = rectified(pixels, taken_by.info)
            return Image(pixels, camera, late)
        return None

    @contextmanager
    def _or_else(self, topic: str, without: str) -> Iterator[None]:
        """Inside, a sensor beside the LiDAR is read; where it cannot be used that is its problem, and told."""
        try:
            yield
        except (UsageError, ValueError) as error:
            self.problems[topic] = self._tell(topic, error, f"; {without}")
        else:
            self.problems.pop(topic, None)

    def _tell(self, topic: str, error: Exception, more: str = "") -> str:
        """Complain unless it is known already; returns the problem as one line."""
        problem = printable(str(error)[:_LENGTH])
        text = f"{topic}: {problem.removeprefix(f'{topic}: ')}{more}"  # a message that is damaged names its topic
        if text not in self._told and len(self._told) < _MOST_REPORTED:
            self._told.add(text)
            self._complain(text)
        return problem
