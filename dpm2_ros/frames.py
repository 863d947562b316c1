# SPDX-License-Identifier: Apache-2.0
"""From messages that belong together to a `Frame`. What cannot be used is said once, and never replaced by a guess."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dpm2_core.data.image_messages import decode_camera, decode_image
from dpm2_core.data.messages import MessageError, decode_points
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Frame, Image
from dpm2_ros.guard import one_line
from dpm2_ros.subscriptions import Inputs
from dpm2_ros.synchronizer import Bundle


class FrameBuilder:
    """Decodes in the worker's thread.

    Args:
        settings: how to read the messages.
        inputs: calibration as it has come in so far.
        complain: called once with each different problem.

    Attributes:
        image_problem: why the last image could not be used; empty if it could, or if there was none.
    """

    def __init__(self, settings: InputSettings, inputs: Inputs, complain: Callable[[str], None]) -> None:
        self._settings, self._inputs, self._complain = settings, inputs, complain
        self._told: set[str] = set()
        self.image_problem = ""

    def frame(self, bundle: Bundle, index: int) -> Frame:
        """The cloud and its images; an unreadable cloud comes with `problem` set."""
        settings = self._settings
        try:
            points, offset = decode_points(
                bundle.cloud, settings.time_field, settings.time_unit, settings.intensity_max
            )
        except MessageError as error:
            self._tell(f"{self._inputs.points_topic}: {error}")
            return Frame(bundle.stamp, np.empty((0, 4), np.float32), index=index, problem=one_line(str(error)))
        points = correct_vertical_angle(points, self._correction())
        return Frame(bundle.stamp, points, offset, self._images(bundle), index)

    def _images(self, bundle: Bundle) -> tuple[Image, ...]:
        message = bundle.images.get(0)
        if message is None:
            return ()
        try:
            if self._inputs.camera_info is None:
                raise MessageError("no CameraInfo yet")
            frame_id = self._inputs.camera_info.header.frame_id or message.header.frame_id
            T_lidar_cam = self._extrinsic(bundle.cloud.header.frame_id, frame_id)
            camera = decode_camera(self._inputs.camera_info, T_lidar_cam, frame_id or self._inputs.image_topic)
            images = (Image(decode_image(message, camera.size), camera),)
        except (UsageError, ValueError) as error:
            self.image_problem = str(error)
            self._tell(f"{self._inputs.image_topic}: {error}; images are left out")
            return ()
        self.image_problem = ""
        return images

    def _extrinsic(self, lidar_frame: str, camera_frame: str) -> Array:
        T_lidar_cam = self._settings.extrinsic()
        if T_lidar_cam is not None:
            return T_lidar_cam
        try:
            return self._inputs.static.tree.lookup(lidar_frame, camera_frame)
        except UsageError as error:
            raise UsageError(f"{error}; publish it on /tf_static or set input.T_lidar_cam") from None

    def _correction(self) -> float:
        requested = self._settings.vertical_angle_correction_deg
        if requested != "auto":
            return requested
        if self._inputs.angle_correction_deg is not None:
            return self._inputs.angle_correction_deg
        return HDL64_CORRECTION_DEG if self._inputs.points_topic.startswith("/kitti/") else 0.0

    def _tell(self, text: str) -> None:
        text = one_line(text)
        if text not in self._told and len(self._told) < 100:  # damaged data may be damaged in endless ways
            self._told.add(text)
            self._complain(text)
