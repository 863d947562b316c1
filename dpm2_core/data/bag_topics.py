# SPDX-License-Identifier: Apache-2.0
"""Selects the topics of a bag: those in the settings, else the usual ones, else the only ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpm2_core.data import naming
from dpm2_core.data.bag_file import Bag
from dpm2_core.data.frames import CameraTopic
from dpm2_core.data.image_messages import decode_camera, info_of, info_topic_beside, is_depth
from dpm2_core.data.message_kinds import CAMERA_INFO, CLOUDS, FIX, IMAGES, IMU, TRUTHS
from dpm2_core.data.messages import MessageError
from dpm2_core.data.naming import frame_name
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError

_MAX_CAMERA_INFOS = 20  # CameraInfo messages, to find one in the frame of the images


class TopicChoice:
    """Selects the topics of one bag; the bag's `notes` name the alternatives.

    Raises:
        UsageError: from its methods: a topic in the settings is missing, or the user must choose one.
    """

    def __init__(self, bag: Bag, path: Path, settings: InputSettings) -> None:
        self._bag, self._path, self._settings = bag, path, settings

    def points(self) -> str:
        """Topic of the point clouds."""
        requested, found = self._settings.points_topic, self._bag.topics(*CLOUDS)
        if requested or not found:
            if requested in found:
                return requested
            hint = (
                "" if requested else "; convert a driver's packets to clouds first, by replaying them into the driver"
            )
            raise UsageError(
                f"{self._path}: no PointCloud2 messages{f' on {requested}' * bool(requested)};"
                f" {self._topic_list()}{hint}"
            )
        if len(found) > 1:
            if naming.POINTS not in found:
                raise UsageError(f"{self._path}: several PointCloud2 topics, choose one with input.points_topic: "
                                 + ", ".join(found))  # fmt: skip
            self._bag.notes.append(f"PointCloud2 topics {', '.join(found)}: {naming.POINTS} was chosen")
            return naming.POINTS
        return found[0]

    def second(self, key: str, first: str, kinds: Sequence[str], messages: str) -> str:
        """The topic of a second sensor, from the setting `key`; empty for none."""
        requested: str = getattr(self._settings, key)
        if requested and (requested == first or requested not in self._bag.topics(*kinds)):
            raise UsageError(f"{self._path}: input.{key}: no other {messages} on {requested}; {self._topic_list()}")
        return requested

    def image(self, second: str) -> str:
        """Image topic of the first camera, different from `second`; empty without one, or if there is only depth."""
        requested, found = self._settings.image_topic, [topic for topic in self._bag.topics(*IMAGES) if topic != second]
        empty = [topic for topic, kind in self._bag.types.items() if kind in IMAGES and topic not in (*found, second)]
        if empty and not requested:
            self._bag.notes.append(f"no message on the image topic {', '.join(empty)}")
        depth = [] if requested else [topic for topic in found if is_depth(self._bag.first(topic))]
        if depth:
            self._bag.notes.append(f"depth images are not used: {', '.join(depth)}")
        compressed = {f"{topic}/compressed" for topic in (*found, second) if topic}  # the same images as the raw topics
        found = [topic for topic in found if topic not in depth and (topic == requested or topic not in compressed)]
        default = naming.IMAGE if naming.IMAGE in found else naming.IMAGE.removesuffix("_raw")  # two kitti2bag variants
        return self._choose(found, requested, default, "image", "images")

    def imu(self) -> str:
        """Topic of an IMU; empty for none."""
        if not self._settings.imu:
            return ""
        return self._choose(self._bag.topics(IMU), self._settings.imu_topic, naming.IMU, "Imu", "Imu messages")

    def gnss(self) -> str:
        """Topic of GNSS fixes; empty for none."""
        requested = self._settings.gnss_topic
        return requested and self._choose(
            self._bag.topics(FIX), requested, requested, "NavSatFix", "NavSatFix messages"
        )

    def camera(self, topic: str, info_topic: str, required: bool) -> CameraTopic | None:
        """The camera of an image topic with its first usable CameraInfo. If the messages are of several cameras, the
        first in the frame of the first image. None without; that is an error if the topic was asked for."""
        info_topic = info_topic or info_topic_beside(topic)
        problem, usable, image = f"no CameraInfo on {info_topic}", list[CameraTopic](), self._bag.first(topic)
        frame = frame_name(image.header.frame_id) if image else ""
        for message in self._bag.decoded(info_topic) if self._bag.types.get(info_topic) == CAMERA_INFO else ():
            info = info_of(topic, message)
            try:
                decode_camera(info, np.eye(4), info_topic)
            except MessageError as error:  # drivers send zeros until they have the calibration
                problem = str(error)
                continue
            usable.append(CameraTopic(topic, info))
            if frame_name(info.header.frame_id) == frame:
                return usable[-1]
            if len(usable) == _MAX_CAMERA_INFOS:
                break
        if usable:
            return usable[0]
        if required:
            raise UsageError(f"{self._path}: {problem} for {topic}; {self._topic_list()}")
        self._bag.notes.append(f"images of {topic} are left out: {problem}")
        return None

    def truth(self) -> str:
        """Topic of the ground truth, empty without any."""
        requested, found = self._settings.ground_truth_topic, self._bag.topics(*TRUTHS)
        if requested and requested not in found:
            raise UsageError(f"{self._path}: no Odometry or Path messages on {requested}; {self._topic_list()}")
        return next((topic for topic in (requested, *naming.TRUTHS) if topic in found), "")

    def _choose(self, found: Sequence[str], requested: str, default: str, kind: str, messages: str) -> str:
        """The requested topic, else the usual one, else the only one; empty if several remain."""
        if requested:
            if requested not in found:
                raise UsageError(f"{self._path}: no {messages} on {requested}; {self._topic_list()}")
            return requested
        if len(found) > 1 and default not in found:
            key = f"input.{kind.lower()}_topic"
            self._bag.notes.append(f"{kind} topics {', '.join(found)}: none is used; choose one with {key}")
            return ""
        return default if default in found else "".join(found)

    def _topic_list(self) -> str:
        listed = (f"{topic} ({kind}, {self._bag.counts[topic]})" for topic, kind in sorted(self._bag.types.items()))
        return f"topics: {', '.join(listed) or 'none'}"
