# SPDX-License-Identifier: Apache-2.0
"""From messages that belong together to a `Frame`. What cannot be used is reported once, never replaced by a guess."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dpm2_core.data.gnss import FixBuffer
from dpm2_core.data.image_messages import decode_camera, decode_image, is_fisheye, rectified
from dpm2_core.data.imu import ImuBuffer
from dpm2_core.data.messages import MessageError, decode_points, why_untimed
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.transforms import TransformTree
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle
from dpm2_core.errors import UsageError, printable
from dpm2_core.frame import Array, Camera, Fix, Frame, Image, Inertial, Points
from dpm2_core.geometry import se3

_MOST_REPORTED = 20  # damaged data may be damaged in endless ways
_LENGTH = 300  # characters of a problem, whatever is in the message


@dataclass(eq=False)
class Calibration:
    """What is known of the sensors: of a recording from the start, of topics as it comes in.

    Attributes:
        points_topic, image_topic, imu_topic, second_topic, gnss_topic: full names; empty where there is none.
        camera_info: sensor_msgs/CameraInfo; None as long as there is none.
        transforms: of /tf_static.
        angle_correction_deg: what the recording says of its vertical angles; None if it says nothing.
    """

    points_topic: str
    image_topic: str = ""
    imu_topic: str = ""
    second_topic: str = ""
    gnss_topic: str = ""
    camera_info: Any = None
    transforms: TransformTree = field(default_factory=TransformTree)
    angle_correction_deg: float | None = None


class FrameBuilder:
    """Makes frames of messages.

    Args:
        settings: how to read the messages.
        calibration: looked at anew for each frame.
        complain: called once with each different problem.
        decode: makes a message of a topic's bytes, or raises MessageError; the default takes messages as they are.
        imu, gnss: where their messages come in; None where none are wanted.

    Attributes:
        up: see `Inertial`.
        imu_problem: why the last scan has no samples, or they cannot be used; empty if they can, or before the first.
        image_problem: why the last image could not be used; empty if it could, or if there was none.
        gnss_problem: why the antenna's place is not known; empty if it is.
        second_problem: why the last cloud of a second LiDAR could not be used; empty likewise.
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
        self.image_problem = self.second_problem = self.time_problem = self.imu_problem = ""
        self._imu, self._gnss, self.gnss_problem = imu, gnss, ""
        self.up: tuple[float, float, float] | None = (0.0, 0.0, 1.0)

    def frame(
        self, stamp: int, cloud: Any, index: int, image: Any = None, second: tuple[int, Any] | None = None
    ) -> Frame:
        """A cloud with its stamp (ns), and what goes with it; an unreadable cloud comes with `problem` set.

        Args:
            image: a message. second: stamp (ns) and message of a second LiDAR.
        """
        topic = self._calibration.points_topic
        try:
            cloud = self._decode(topic, cloud)
            points, offset = self._points(cloud)
        except MessageError as error:
            problem = self._tell(topic, error)
            return Frame(stamp, np.empty((0, 4), np.float32), index=index, problem=problem)
        expected = self._settings.time_field is None and not topic.startswith("/kitti/") and len(points)
        self.time_problem = f"{why_untimed(cloud)}: not de-skewed" if offset is None and expected else ""
        points = correct_vertical_angle(points, self.angle_correction_deg)
        lidar_frame = cloud.header.frame_id
        if second is not None:
            points, offset = self._joined(points, offset, lidar_frame, (second[0] - stamp) * 1e-9, second[1])
        imu = None if self._imu is None else self._inertial(self._imu, lidar_frame, stamp, offset)
        fix = None if self._gnss is None else self._fix(self._gnss, lidar_frame, stamp)
        return Frame(stamp, points, offset, self._images(lidar_frame, image), index, imu=imu, fix=fix)

    def _points(self, cloud: Any) -> tuple[Points, Points | None]:
        """(N, 4), and (N,) s after the stamp, of a decoded message."""
        settings = self._settings
        return decode_points(cloud, settings.time_field, settings.time_unit, settings.intensity_max)

    def _joined(
        self, points: Points, offset: Points | None, lidar_frame: str, late: float, second: Any
    ) -> tuple[Points, Points | None]:
        """Points (N, 4) with those of a second LiDAR, `late` s after them; their times (N,) with its."""
        topic = self._calibration.second_topic
        try:
            second = self._decode(topic, second)
            others, other_offset = self._points(second)
            T = self._calibration.transforms.lookup(lidar_frame, second.header.frame_id)
        except (MessageError, UsageError) as error:
            self.second_problem = self._tell(topic, error, "; going on without the second LiDAR")
            return points, offset
        self.second_problem = ""
        if offset is not None or other_offset is not None or late:
            first = np.zeros(len(points), np.float32) if offset is None else offset
            then = np.zeros(len(others), np.float32) if other_offset is None else other_offset
            offset = np.concatenate([first, then + np.float32(late)])
        return np.concatenate([points, se3.transform(T, others)]), offset

    def camera(self, lidar_frame: str, image_frame: str) -> Camera:
        """The camera by what is known now; `image_frame` counts where its CameraInfo names no frame.

        Raises:
            UsageError: CameraInfo or extrinsics are missing, or cannot be used.
        """
        info, T_lidar_cam = self._calibration.camera_info, self._settings.extrinsic()
        if info is None:
            raise UsageError("no CameraInfo yet")
        frame = info.header.frame_id or image_frame
        if T_lidar_cam is None:
            try:
                T_lidar_cam = self._calibration.transforms.lookup(lidar_frame, frame)
            except UsageError as error:
                hint = "set input.T_lidar_cam, publish it on /tf_static, or leave images out with input.images=false"
                raise UsageError(f"{error}; {hint}") from None
        return decode_camera(info, T_lidar_cam, frame or self._calibration.image_topic)

    @property
    def angle_correction_deg(self) -> float:
        """Added to the elevation of each point: what is set, else what the recording says, else KITTI's for KITTI."""
        requested, known = self._settings.vertical_angle_correction_deg, self._calibration
        if requested != "auto":
            return requested
        usual = HDL64_CORRECTION_DEG if known.points_topic.startswith("/kitti/") else 0.0
        return usual if known.angle_correction_deg is None else known.angle_correction_deg

    def _inertial(self, buffer: ImuBuffer, lidar_frame: str, stamp: int, offset: Points | None) -> Inertial | None:
        """The samples up to the last point of a scan, along the LiDAR's axes."""
        if buffer.last == -float("inf"):
            return None
        sweep = 0.0 if offset is None or not len(offset) else max(float(np.nanmax(offset)), 0.0)
        found, topic = buffer.take(stamp, stamp + round(sweep * 1e9)), self._calibration.imu_topic
        try:
            if found is None:
                raise UsageError("no samples at the time of the scan")
            R = self._imu_rotation(lidar_frame, buffer.frame)
        except UsageError as error:
            self.imu_problem = self._tell(topic, error, "; going on without the IMU")
            return None
        self.imu_problem = ""
        return replace(found, rates=found.rates @ R.T, forces=found.forces @ R.T, up=self.up)

    def _imu_rotation(self, lidar_frame: str, imu_frame: str) -> Array:
        """R_lidar_imu (3, 3)."""
        R = self._settings.imu_rotation()
        if R is not None:
            return R
        if lidar_frame.lstrip("/") == imu_frame.lstrip("/"):
            return np.eye(3)
        try:
            return self._calibration.transforms.lookup(lidar_frame, imu_frame)[:3, :3]
        except UsageError as error:
            raise UsageError(f"{error}; set input.q_lidar_imu, or publish it on /tf_static") from None

    def _fix(self, buffer: FixBuffer, lidar_frame: str, stamp: int) -> Fix | None:
        """The last fix before a scan, with the place of its antenna."""
        fix, self.gnss_problem = buffer.take(stamp), ""
        if fix is None or buffer.frame.lstrip("/") == lidar_frame.lstrip("/"):
            return fix
        try:
            return replace(fix, antenna=self._calibration.transforms.lookup(lidar_frame, buffer.frame)[:3, 3])
        except (UsageError, ValueError) as error:
            self.gnss_problem = self._tell(self._calibration.gnss_topic, error, "; the antenna is taken for the LiDAR")
            return fix

    def _images(self, lidar_frame: str, message: Any | None) -> tuple[Image, ...]:
        if message is None:
            return ()
        topic = self._calibration.image_topic
        try:
            message = self._decode(topic, message)
            camera = self.camera(lidar_frame, message.header.frame_id)
            pixels, info = decode_image(message, camera.size), self._calibration.camera_info
            if is_fisheye(info) and pixels.shape[1::-1] == camera.size:
                pixels = rectified(pixels, info)
            images = (Image(pixels, camera),)
        except (UsageError, ValueError) as error:
            self.image_problem = self._tell(topic, error, "; images are left out")
            return ()
        self.image_problem = ""
        return images

    def _tell(self, topic: str, error: Exception, more: str = "") -> str:
        """Complain unless it is known already; returns the problem as one line."""
        problem = printable(str(error)[:_LENGTH])
        text = f"{topic}: {problem.removeprefix(f'{topic}: ')}{more}"  # a message that is damaged names its topic
        if text not in self._told and len(self._told) < _MOST_REPORTED:
            self._told.add(text)
            self._complain(text)
        return problem
