# SPDX-License-Identifier: Apache-2.0
"""The mapper apart from the odometry: on another machine, or one a robot. Keyframes in, map out."""

from __future__ import annotations

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from dpm2_core.data.messages import decode_points, stamp_ns
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.errors import UsageError
from dpm2_core.frame import Keyframe, Points, Registration
from dpm2_core.geometry import se3
from dpm2_ros.conversions import covariance_from_ros, parse_keyframe_name
from dpm2_ros.mapping import KEEP_ALL, MapperThread, robot_name
from dpm2_ros.parameters import load_parameters
from dpm2_ros.settings import NodeConfig


class MapperNode(Node):
    """Joins `dpm2/keyframe` and `dpm2/keyframe_odom` of one robot, which may come in either order, into keyframes."""

    def __init__(self) -> None:
        super().__init__("mapper_node", automatically_declare_parameters_from_overrides=True)
        config = load_parameters(self, NodeConfig)
        self._mapper = MapperThread(self, config, robot_name(self))
        self._clouds: dict[str, PointCloud2] = {}
        self._poses: dict[str, Odometry] = {}
        self._last: Keyframe | None = None
        self.create_subscription(PointCloud2, "dpm2/keyframe", self._on_cloud, KEEP_ALL)
        self.create_subscription(Odometry, "dpm2/keyframe_odom", self._on_pose, KEEP_ALL)
        self.create_subscription(Odometry, "dpm2/odom", self._on_odom, 10)
        self.create_service(Trigger, "~/reset", self._on_reset)

    def close(self) -> None:
        """Save the map.

        Raises:
            Dpm2Error: the map could not be written.
        """
        self._mapper.close()

    def _on_odom(self, message: Odometry) -> None:
        self._mapper.broadcast(stamp_ns(message.header))

    def _on_cloud(self, message: PointCloud2) -> None:
        self._clouds[message.header.frame_id] = message
        self._join(message.header.frame_id)

    def _on_pose(self, message: Odometry) -> None:
        self._poses[message.child_frame_id] = message
        self._join(message.child_frame_id)

    def _join(self, name: str) -> None:
        """Make the keyframe when both of its messages are there; a half whose other never came is forgotten."""
        if name not in self._clouds or name not in self._poses:
            return
        cloud, pose = self._clouds.pop(name), self._poses.pop(name)
        for halves in (self._clouds, self._poses):
            while len(halves) > 100:
                halves.pop(next(iter(halves)))
        try:
            robot, id = parse_keyframe_name(name)
            points, _ = decode_points(cloud, time_field="", intensity_max=1.0)
            keyframe = keyframe_from(pose, points, robot, id, self._last)
        except UsageError as error:
            self.get_logger().error(f"keyframe {name}: {error}", throttle_duration_sec=5)
            return
        if self._last is not None and keyframe.edge is None:
            self.get_logger().warning(f"keyframe {id} after {self._last.id}: the odometry has started again")
            self._mapper.reset(save=True)
        self._last = keyframe
        self._mapper.add(keyframe)

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._mapper.reset(save=False)
        self._last = None
        response.success, response.message = True, "the map is empty"
        return response


def keyframe_from(pose: Odometry, points: Points, robot: str, id: int, before: Keyframe | None) -> Keyframe:
    """A keyframe from its messages; its edge leads to the last one that arrived (the mapper reckons with those missed).

    Raises:
        UsageError: the pose is no rigid transform.
    """
    T_odom_kf = transform_matrix(pose.pose.pose)
    edge = None
    if before is not None and id > before.id:
        covariance = covariance_from_ros(pose.pose.covariance, T_odom_kf[:3, :3])
        T_before_this = se3.inverse(before.T_odom_kf) @ T_odom_kf
        edge = Registration(T_before_this, covariance, confidence=1.0, rmse=0.0, method="odometry")
    return Keyframe(id, stamp_ns(pose.header), id, T_odom_kf, points, edge, robot)
