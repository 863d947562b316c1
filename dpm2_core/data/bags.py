# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 or ROS 1 bag as a `Source`: clouds with the image nearest in time, IMU, calibration and ground truth."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data import naming
from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bag_topics import TopicChoice
from dpm2_core.data.frames import Calibration, CameraTopic, FrameBuilder
from dpm2_core.data.gnss import FixBuffer
from dpm2_core.data.imu import ImuBuffer
from dpm2_core.data.message_kinds import CLOUDS, IMAGES, PATH
from dpm2_core.data.messages import MessageError, decode_points, serialized_frame, serialized_stamp, stamp_ns
from dpm2_core.data.naming import frame_name
from dpm2_core.data.pairing import AHEAD, JUMP, SWEEP, Beside, RawMessage, clouds_after_others, is_due
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import note_once
from dpm2_core.data.time_order import in_order, note_corrected
from dpm2_core.data.trajectory import interpolate
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.data.vertical_angle import checked_correction
from dpm2_core.errors import UsageError, printable
from dpm2_core.frame import Array, Camera, Frame, Points
from dpm2_core.geometry.scale import is_room
from dpm2_core.geometry.tilt import up_of

Stamps = NDArray[np.int64]
_WORLD_FRAMES = ("map", "odom")  # frames that a base moves in
_MAX_GROUND_CLOUDS = 10  # clouds, to find the ground
# A larger tilt of the LiDAR is reported; largest angle between the base and the ground.
_MIN_COS_TILT, _MIN_COS_SAME_UP = np.cos(np.radians([10.0, 45.0]))

_MAX_DELAY_DIFFERENCE = 0.15
"""s: a larger difference between the delays from stamp to recording of two LiDARs suggests that their clocks differ.
Whether a driver stamps the start or the end of a sweep makes a smaller difference."""


class BagSource:
    """A rosbag2 folder, or a .mcap, .db3 or .bag file. See `Source`; `Frame.index` counts the clouds.

    Attributes:
        T_base_lidar: (4, 4) how the LiDAR is mounted; None if /tf_static does not define it.
        in_order: the stamps of its clouds are corrected before images and IMU are associated with them.

    Raises:
        UsageError: it cannot be read, has no point clouds, leaves the choice of a topic open, or has a camera with
            intrinsics but without a known pose.
    """

    in_order = True

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        self._settings = settings or InputSettings()
        self.path = Path(path)
        self.name = self.path.resolve().stem
        self._bag = open_bag(self.path)
        self.notes = self._bag.notes
        self._topics = TopicChoice(self._bag, self.path, self._settings)
        self.points_topic = self._topics.points()
        first = self._bag.first(self.points_topic)
        self.lidar_frame: str = first.header.frame_id if first else ""
        second = self._topics.second("second_points_topic", self.points_topic, CLOUDS, "point clouds")
        correction = self._recorded_correction()
        self._calibration = Calibration(
            self.points_topic, second_topic=second, lidar_frame=self.lidar_frame, angle_correction_deg=correction
        )
        self.transforms = self._calibration.transforms
        self._add_transforms()
        self.T_cam_lidar: Array | None = None
        if naming.GRAY_CAMERA in self.transforms.frames:
            self.T_cam_lidar = self.transforms.lookup(naming.GRAY_CAMERA, self.lidar_frame)
        self.imu_topic = self._calibration.imu_topic = self._topics.imu()
        self._calibration.gnss_topic = self._topics.gnss()
        self._imu, self._gnss = ImuBuffer(), FixBuffer()
        self._delays: dict[str, list[int]] = {}  # ns from stamp to time of recording, of the clouds of each topic
        self._skipped: dict[str, tuple[int, str]] = {}  # by topic: messages left out, and why the first one was
        imu, gnss = self._imu if self.imu_topic else None, self._gnss if self._calibration.gnss_topic else None
        self.T_base_lidar = self._mounting(first)
        self._frames = FrameBuilder(self._settings, self._calibration, self.notes.append, self._bag.decode, imu, gnss)
        if self.T_base_lidar is not None:
            x, y, z = self.T_base_lidar[2, :3].tolist()
            self._frames.up = x, y, z
        self.vertical_angle_correction_deg = self._frames.angle_correction_deg
        self.camera = self._choose_cameras() if self._settings.images else None

    def __len__(self) -> int:
        return self._bag.counts[self.points_topic]

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1 as recorded, even if their stamps repeat or go back; `notes` reports that."""
        last_stamp, last_recorded, period, count, calibration = None, 0, 0, 0, self._calibration
        found, unusable = Counter[str](), Counter[str]()  # by topic: frames with a message, with an unusable message
        self._imu.clear()
        self._gnss.clear()
        self._skipped.clear()
        calibration.heard.clear()
        for index, (stamp, recorded, cloud, associated) in enumerate(islice(self._clouds_with_messages(), stop)):
            if index < start:
                continue
            if last_stamp is not None and stamp <= last_stamp:
                note_once(
                    self.notes, "time stamps do not increase", f"at frame {index}: {(stamp - last_stamp) * 1e-9:+.3f} s"
                )
            step, elapsed = (0, 0) if last_stamp is None else (stamp - last_stamp, recorded - last_recorded)
            # A step of less than a second counts only if the cloud came when it was due: else some may be lost.
            stepped = step - elapsed > (min(AHEAD * period, JUMP) if is_due(elapsed, period) else JUMP)
            period = period if stepped or step <= 0 else step
            frame = replace(self._frames.frame(stamp, cloud, index, associated), stepped=stepped)
            last_stamp, last_recorded, count = stamp, recorded, count + 1
            found.update(list(associated))
            unusable.update([topic for topic in associated if topic in self._frames.problems and not frame.problem])
            found[calibration.gnss_topic] += frame.fix is not None and stamp - frame.fix.stamp < JUMP
            if self._frames.time_problem:
                note_once(self.notes, f"{self.points_topic}: {self._frames.time_problem}", f"first at frame {index}")
            yield frame
        for topic, (skipped, reason) in self._skipped.items():
            note_once(self.notes, f"{topic}: {skipped} samples left out", f"the first: {reason}")
        self._note_missing(found, unusable, count)

    def _note_missing(self, found: Counter[str], unusable: Counter[str], count: int) -> None:
        """Note what is missing from the other sensors. `found`: number of the `count` frames that have a message of
        each topic; `unusable`: number of those whose message cannot be used."""
        calibration, within = self._calibration, f"within {self._settings.image_tolerance} s"
        missing = [(camera.topic, "image", within) for camera in calibration.cameras]
        if calibration.second_topic:
            missing.append((calibration.second_topic, "cloud", within))
        if calibration.gnss_topic and not found[calibration.gnss_topic] and count:  # fixes are rarer than clouds
            missing.append((calibration.gnss_topic, "fix", f"within {JUMP * 1e-9:g} s"))
        for topic, what, within in missing:
            absent_count, unusable_count = count - found[topic], unusable[topic]
            details = [(absent_count, within), (unusable_count, f"{unusable_count} have an unusable one")]
            if absent_count or unusable_count:
                text = f"{absent_count + unusable_count} of {count} frames have no {what} of {topic}"
                note_once(self.notes, text, "; ".join(detail for occurrences, detail in details if occurrences))
        if found[calibration.second_topic]:
            first, second = (
                float(np.median(self._delays[t])) for t in (calibration.points_topic, calibration.second_topic)
            )
            if abs(lag := (second - first) * 1e-9) > _MAX_DELAY_DIFFERENCE:
                what = f"{calibration.second_topic}: recorded {lag:+.2f} s later after its stamps than the first LiDAR"
                note_once(self.notes, what, "is its clock off? Clouds with the same stamps are joined")

    @cached_property
    def stamps(self) -> Stamps:
        """(len,) ns: the header's stamp, or the time of recording if the stamp is 0. Reads all clouds once."""
        clouds = self._in_order(self._bag.messages([self.points_topic]))
        return np.array([serialized_stamp(data, time) for _, time, data in clouds], np.int64)

    @cached_property
    def poses(self) -> Array | None:
        """(len, 4, 4) T_world_lidar ground truth interpolated at the stamps, NaN where unknown; None without any.

        Raises:
            UsageError: the topic is set, but its frame is not connected with the LiDAR; for other topics this is noted.
        """
        if not self.truth:
            return None
        try:
            stamps, T = self._read_truth(self.truth)
        except UsageError as error:
            if self._settings.ground_truth_topic:
                raise UsageError(f"{self.path}: {self.truth}: {error}") from None
            note_once(self.notes, f"{self.truth} is not used as ground truth", str(error))
            return None
        poses = interpolate(stamps, T, self.stamps)
        if missing := int(np.isnan(poses[:, 0, 0]).sum()):
            times = f"poses from {_span(stamps)}, clouds from {_span(self.stamps)}"
            note_once(self.notes, f"{self.truth}: {missing} of {len(poses)} frames have no pose", times)
        return poses

    @cached_property
    def truth(self) -> str:
        """Topic of the ground truth; empty without any."""
        return self._topics.truth()

    def _choose_cameras(self) -> Camera | None:
        """Find the cameras; returns the first one, or None if there is none."""
        settings, calibration = self._settings, self._calibration
        second = self._topics.second("second_image_topic", settings.image_topic, IMAGES, "images")
        if topic := self._topics.image(second):
            required = bool(settings.image_topic or settings.camera_info_topic)
            calibration.camera = self._topics.camera(topic, settings.camera_info_topic, required)
        if second:
            calibration.second_camera = self._topics.camera(second, "", required=True)
        cameras = [self._camera(camera) for camera in calibration.cameras]
        return None if calibration.camera is None else cameras[0]

    def _camera(self, camera: CameraTopic) -> Camera:
        image = None if camera.info.header.frame_id else self._bag.first(camera.topic)
        try:
            return self._frames.camera(camera, self.lidar_frame, image.header.frame_id if image else "")
        except UsageError as error:
            problem = str(error).removeprefix(f"{camera.topic}: ")
            raise UsageError(f"{self.path}: camera {camera.topic}: {problem}") from None

    def _add_transforms(self) -> None:
        """Add the transforms of /tf_static; invalid ones are left out, with a note."""
        problems = list[str]()
        for _, _, data in self._bag.messages([naming.TF_STATIC]):
            try:
                problems += self.transforms.add(self._bag.decode(naming.TF_STATIC, data))
            except MessageError as error:
                problems.append(str(error))
        if problems:
            what = f"{naming.TF_STATIC}: {len(problems)} transforms left out"
            note_once(self.notes, what, f"the first: {printable(problems[0])}")

    def _mounting(self, first: Any) -> Array | None:
        """T_base_lidar (4, 4); the base is, as in slam_node, the root above the LiDAR in /tf_static.

        None without a base, or if the first clouds show that the root is not one, such as the frame of a camera.
        """
        base = self.transforms.root(self.lidar_frame, _WORLD_FRAMES)
        if first is None or base == frame_name(self.lidar_frame):
            return None
        T_base_lidar = self.transforms.lookup(base, self.lidar_frame)
        up = T_base_lidar[2, :3]
        if up[2] > _MIN_COS_TILT:
            return T_base_lidar
        angle = float(np.degrees(np.arccos(max(up[2], -1.0))))
        tilted = f"{naming.TF_STATIC} shows the LiDAR tilted by {angle:.0f} degrees in {base}"
        ground_up = self._up_from_ground()
        if ground_up is not None and ground_up @ up < _MIN_COS_SAME_UP:
            note_once(self.notes, tilted, "which is not used as base: the ground is not level in it")
            return None
        note_once(self.notes, tilted, "by which the map is leveled")
        return T_base_lidar

    def _up_from_ground(self) -> Points | None:
        """Up direction (3,) in the LiDAR frame, estimated from the ground in the first cloud that shows enough of it.
        The first clouds of a driver may be empty or part of a sweep. Only outdoor clouds count, as ceilings look like
        ground."""
        for cloud in islice(self._bag.decoded(self.points_topic), _MAX_GROUND_CLOUDS):
            with suppress(MessageError):
                points, _ = decode_points(cloud)
                if is_room(points) is False and (up := up_of(points)) is not None:
                    return up
        return None

    def _recorded_correction(self) -> float | None:
        topic, is_auto = naming.VERTICAL_ANGLE_CORRECTION, self._settings.vertical_angle_correction_deg == "auto"
        message = self._bag.first(topic) if is_auto else None
        return None if message is None else checked_correction(float(message.data), f"{self.path}: {topic}")

    def _clouds_with_messages(self) -> Iterator[tuple[int, int, bytes, dict[str, tuple[int, bytes]]]]:
        """(stamp, time of recording, cloud, topic to stamp and message associated with it), messages serialized. The
        IMU samples before the cloud are in the buffer by then."""
        calibration, offset = self._calibration, round(self._settings.image_time_offset * 1e9)
        others = dict.fromkeys((camera.topic for camera in calibration.cameras), offset)
        without_time_offset = ((calibration.second_topic, 0), (self.imu_topic, -SWEEP))
        others |= {topic: stamp_offset for topic, stamp_offset in without_time_offset if topic}
        buffers = {topic: Beside(self._settings.image_tolerance) for topic in others if topic != self.imu_topic}
        gnss = calibration.gnss_topic  # clouds do not wait for fixes: a late fix can still be placed on the trajectory
        messages = self._in_order(self._bag.messages([self.points_topic, *others, *([gnss] if gnss else [])]))
        waiting: deque[tuple[int, RawMessage]] = deque()
        delays = self._delays = {topic: [] for topic in (self.points_topic, calibration.second_topic)}
        for topic, time, data in clouds_after_others(messages, [self.points_topic], others, waiting):
            stamp = serialized_stamp(data, time)
            if topic in delays:
                delays[topic].append(time - stamp)
            if topic == self.points_topic:
                found = ((other, buffer.nearest(stamp)) for other, buffer in buffers.items())
                yield stamp, time, data, {other: message for other, message in found if message is not None}
                for buffer in buffers.values():
                    buffer.forget(stamp)
                continue
            with self._skip_invalid(topic):
                if topic in (self.imu_topic, gnss):
                    sample = self._bag.decode(topic, data)
                    calibration.check_sensor(topic, sample.header.frame_id, stamp)
                    (self._imu if topic == self.imu_topic else self._gnss).add(stamp, sample)
                else:
                    if topic != calibration.second_topic:  # whose clouds are each transformed from their own frame
                        calibration.check_sensor(topic, serialized_frame(data), stamp)
                    buffers[topic].add(stamp + others[topic], data, [cloud for cloud, _ in waiting])

    def _in_order(self, messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
        """The messages, with corrected stamps where a cloud's stamp is not between its neighbors'; this is noted."""
        topic = self.points_topic
        return in_order(messages, topic, partial(note_corrected, self.notes, whose=f"{topic}: "))

    @contextmanager
    def _skip_invalid(self, topic: str) -> Iterator[None]:
        """Guards the handling of a message of a sensor other than the LiDAR; an invalid one is skipped and counted."""
        try:
            yield
        except MessageError as error:
            skipped, reason = self._skipped.get(topic, (0, str(error)))
            self._skipped[topic] = skipped + 1, reason

    def _read_truth(self, topic: str) -> tuple[Stamps, Array]:
        """Stamps (M,) ns and T_world_lidar (M, 4, 4). Of several Path messages the last, the most complete, counts.
        Poses that cannot be decoded, or are no rigid transforms, are left out, with a note.

        Raises:
            UsageError: the poses are in a frame that is not connected with the LiDAR.
        """
        decoded, stamps, T, problems = list[tuple[int, Any]](), list[int](), list[Array](), list[str]()
        for _, time, data in self._bag.messages([topic]):
            try:
                decoded.append((serialized_stamp(data, time), self._bag.decode(topic, data)))
            except MessageError as error:
                problems.append(str(error))
        if is_path := self._bag.types[topic] == PATH:
            poses = [(stamp_ns(item.header), item.pose) for _, message in decoded[-1:] for item in message.poses]
        else:
            poses = [(stamp, message.pose.pose) for stamp, message in decoded]
        for stamp, pose in poses:
            try:
                T.append(transform_matrix(pose))
                stamps.append(stamp)
            except UsageError as error:
                problems.append(f"at {stamp * 1e-9:.3f} s: {error}")
        if problems:
            what = f"{topic}: {len(problems)} poses left out"
            note_once(self.notes, what, f"the first: {printable(problems[0])}")
        T_world_lidar = np.array(T).reshape(-1, 4, 4)
        child = "" if is_path or not decoded else decoded[0][1].child_frame_id
        if child:
            T_world_lidar = T_world_lidar @ self.transforms.between(child, self.lidar_frame)
        return np.array(stamps, np.int64), T_world_lidar


def _span(stamps: Stamps) -> str:
    return f"{stamps.min() * 1e-9:.3f} to {stamps.max() * 1e-9:.3f} s" if len(stamps) else "none"
