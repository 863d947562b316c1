# SPDX-License-Identifier: Apache-2.0
"""A slam_node over real DDS, with a LiDAR, a camera and subscriptions around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from dpm2_core.data.messages import decode_points, stamp_ns
from dpm2_core.data.naming import IMAGE, KITTI, POINTS
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.frame import Array
from dpm2_ros.conversions import columns_to_msg, transform_to_msg
from dpm2_ros.mapping import KEEP_ALL
from dpm2_ros.slam_node import SlamNode
from dpm2_ros.stamps import stamp_to_msg
from dpm2_ros.tf_message import TFMessage
from test.helpers.diagnostics import having

ACCURATE = 0.05  # m: the scans are exact, sampled at 0.35 m, and averaged into voxels of 0.5 m


class Rig:
    """A slam_node, a LiDAR, and subscriptions."""

    def __init__(self, ros: Callable[..., Any], drive: Any, *parameters: str, reliable: bool = True, **options: Any):
        quiet = () if any(p.startswith("input.images") for p in parameters) else ("input.images:=false",)
        self.harness = ros(*quiet, *parameters, **options)
        self.drive = drive
        self.lidar = self.harness.publisher(PointCloud2, POINTS, reliable)
        self.odom = self.harness.hear(Odometry, f"{options.get('namespace', '')}/dpm2/odom", KEEP_ALL)
        self.diagnostics = self.harness.diagnostics
        self.node: SlamNode = self.harness.add(SlamNode())
        self.wait = self.harness.wait
        self.wait(lambda: self.lidar.get_subscription_count(), "the subscription to the clouds")
        self.wait(lambda: self.node.count_subscribers(self.odom_topic), "the test's subscription")

    @property
    def odom_topic(self) -> str:
        return self.node.resolve_topic_name("dpm2/odom")

    def send(self, n: int, stamp: int | None = None, **changes: Any) -> None:
        message = self.drive.cloud(n, **changes)
        if stamp is not None:
            message.header.stamp = stamp_to_msg(stamp)
        self.lidar.publish(message)

    def send_and_wait(self, *numbers: int, **changes: Any) -> None:
        """Send clouds one by one, each after the odometry of the previous one was received."""
        for n in numbers:
            before = len(self.odom)
            self.send(n, **changes)
            self.wait(lambda before=before: len(self.odom) > before, f"the odometry of cloud {n}")

    def parts(self, n: int, count: int = 10) -> list[PointCloud2]:
        """Scan n as so many clouds, like those of a driver that publishes each packet."""
        points, _ = decode_points(self.drive.cloud(n))
        turn = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
        out = []
        for k in range(count):
            inside = (turn >= k / count) & (turn < (k + 1) / count)
            columns = {name: points[inside, i] for i, name in enumerate(("x", "y", "z"))}
            columns["time"] = (0.1 * (turn[inside] - k / count)).astype(np.float32)
            out.append(columns_to_msg(columns, self.drive.stamp(n) + self.drive.period * k // count, "lidar"))
        return out

    def send_in_parts(self, n: int) -> None:
        """Scan n as ten clouds, each when the previous one has come out."""
        for k, part in enumerate(self.parts(n)):
            before = len(self.odom)
            self.lidar.publish(part)
            self.wait(lambda before=before: len(self.odom) > before, f"the odometry of part {k} of scan {n}")

    def status(
        self, part: str, condition: Callable[[DiagnosticStatus], Any], since: int | None = None
    ) -> DiagnosticStatus:
        """The first status of a part that fulfills the condition."""
        found: DiagnosticStatus = self.harness.status(f"slam_node: {part}", condition, since)
        return found

    def processed(self, count: int) -> DiagnosticStatus:
        """Status of the odometry once `count` clouds have been processed. Other results of a cloud may arrive
        before."""
        return self.status("odometry", having(processed=count), since=0)

    def mapped(self, count: int) -> None:
        """Wait until `count` keyframes are in the map, and all their processing is done."""
        self.status("mapper", having(keyframes=count, waiting=0))

    @property
    def keyframes(self) -> int:
        """Number of keyframes in the map of the node."""
        return len(self.node.slam.mapper.keyframes)

    def off(self, pose: Callable[[int], Array]) -> float:
        """Largest position error of the published poses, m. `pose`: true pose (4, 4) by number."""
        poses = [transform_matrix(message.pose.pose) for message in self.odom]
        return max(float(np.linalg.norm((T - pose(n))[:3, 3])) for n, T in enumerate(poses))

    def stamps(self) -> list[int]:
        return [stamp_ns(message.header) for message in self.odom]


class Camera:
    """A camera of black images, 8 by 6 pixels."""

    def __init__(
        self, r: Rig, image: str = IMAGE, info: str = f"{KITTI.camera}/camera_info", frame: str = "camera"
    ) -> None:
        self._rig, self._frame = r, frame
        self._image, self._info = r.harness.publisher(Image, image), r.harness.publisher(CameraInfo, info)
        r.wait(
            lambda: self._image.get_subscription_count() and self._info.get_subscription_count(),
            "subscribers",
        )

    def send(self, n: int, offset: float = 0.0) -> None:
        stamp = self._rig.drive.stamp(n) + round(offset * 1e9)
        info = CameraInfo(height=6, width=8, distortion_model="plumb_bob", k=[5.0, 0, 4, 0, 5, 3, 0, 0, 1])
        info.p = [5.0, 0, 4, 0, 0, 5, 3, 0, 0, 0, 1, 0]
        image = Image(height=6, width=8, encoding="rgb8", step=24, data=bytes(144))
        for message in (info, image):
            message.header.stamp, message.header.frame_id = stamp_to_msg(stamp), self._frame
        self._info.publish(info)
        self._image.publish(image)


def record_frames(r: Rig) -> list[Any]:
    """Frames that the odometry receives from now on."""
    frames: list[Any] = []
    process = r.node.slam.odometry.process

    def recording(frame: Any) -> Any:
        frames.append(frame)
        return process(frame)

    r.node.slam.odometry.process = recording  # type: ignore[method-assign]
    return frames


def publish_static(r: Rig, parent: str, child: str, T: Any) -> None:
    """Publish a transform with a separate publisher, as drivers and robot_state_publisher do."""
    publisher = r.harness.publisher(TFMessage, "/tf_static", latched=True)
    publisher.publish(TFMessage(transforms=[transform_to_msg(T, 0, parent, child)]))
    r.wait(lambda: child in r.node.calibration.transforms.frames, "/tf_static")
