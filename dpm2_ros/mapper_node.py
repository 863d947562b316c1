# SPDX-License-Identifier: Apache-2.0
"""The mapper apart from the odometry: on another machine, of one robot or of many. Keyframes in, one map out."""

from __future__ import annotations

from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray, UInt32MultiArray
from std_srvs.srv import Trigger

from dpm2_core.data.messages import stamp_ns
from dpm2_core.data.transforms import transform_matrix
from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import UsageError
from dpm2_core.frame import Keyframe, Points, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.map.cloud_codec import unpack_cloud
from dpm2_ros.conversions import covariance_from_ros, parse_keyframe_name
from dpm2_ros.keyframes import WIRE, descriptors_from_msg, received_to_msg
from dpm2_ros.mapping import MapperThread, robot_name
from dpm2_ros.parameters import load_parameters
from dpm2_ros.settings import NodeConfig
from dpm2_ros.subscriptions import STEADY

_ODOM = "/dpm2/keyframe_odom"


class MapperNode(Node):
    """Listens to every robot in its namespace and below, also to those that come later, and makes one map of all.

    map -> odom of each goes out for the odometry frame that the robot itself names.
    """

    def __init__(self) -> None:
        super().__init__("mapper_node", automatically_declare_parameters_from_overrides=True)
        config = load_parameters(self, NodeConfig)
        if config.ros.localization_mode:
            raise UsageError("ros.localization_mode: is for slam_node")
        self._mapper = MapperThread(self, config, robot_name(self))
        self._feeds: dict[str, Feed] = {}
        self._discover()
        self.create_timer(0.5, self._discover, clock=STEADY)
        self.create_timer(0.5, self._acknowledge, clock=STEADY)
        self.create_service(Trigger, "~/reset", self._on_reset)

    def close(self) -> None:
        """Save the map.

        Raises:
            Dpm2Error: the map could not be written.
        """
        self._mapper.close()

    def _discover(self) -> None:
        """Listen to the robots that are there, and to the one of this very namespace in any case."""
        own = self.get_namespace().rstrip("/")
        topics = [topic for topic, _ in self.get_topic_names_and_types() if topic.endswith(_ODOM)]
        for namespace in {own, *(topic.removesuffix(_ODOM) for topic in topics)}:
            if namespace not in self._feeds and f"{namespace}/".startswith(f"{own}/"):
                self._feeds[namespace] = Feed(self, self._mapper, namespace)

    def _acknowledge(self) -> None:
        for feed in self._feeds.values():
            feed.acknowledge()

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._mapper.reset()
        for feed in self._feeds.values():
            feed.forget()
        response.success, response.message = True, "the map is saved, and begins again empty"
        return response


class Feed:
    """One robot: joins its messages into keyframes, in their order, and tells it which have arrived."""

    def __init__(self, node: Node, mapper: MapperThread, namespace: str) -> None:
        self._node, self._mapper, self._robot = node, mapper, namespace.strip("/")
        self._parts: dict[str, dict[str, Any]] = {}  # halves of keyframes, by name
        self._session: str | None = None
        self._ended: set[str] = set()  # sessions
        self._next = 0  # all ids below have gone to the mapper
        self._above: dict[int, Any] = {}  # messages that came before their turn, by id
        self._last: Keyframe | None = None
        listen = node.create_subscription
        listen(Odometry, namespace + _ODOM, lambda m: self._on_part("pose", m.child_frame_id, m), WIRE)
        listen(PointCloud2, f"{namespace}/dpm2/keyframe", lambda m: self._on_part("seen", m.header.frame_id, m), WIRE)
        listen(UInt8MultiArray, f"{namespace}/dpm2/keyframe_cloud", self._on_cloud, WIRE)
        listen(Odometry, f"{namespace}/dpm2/odom", self._on_odom, 10)
        self._received = node.create_publisher(UInt32MultiArray, f"{namespace}/dpm2/keyframes_received", 10)

    def acknowledge(self) -> None:
        """Tell the robot what has arrived."""
        if self._session:
            self._received.publish(received_to_msg(self._session, self._next, sorted(self._above)[:1000]))

    def forget(self) -> None:
        """The map is empty: the next keyframe is the first."""
        self._last = None

    def _on_odom(self, message: Odometry) -> None:
        self._mapper.broadcast(stamp_ns(message.header), self._robot, message.header.frame_id)

    def _on_cloud(self, message: UInt8MultiArray) -> None:
        if message.layout.dim:
            self._on_part("cloud", message.layout.dim[0].label, message)

    def _on_part(self, part: str, name: str, message: Any) -> None:
        """Of a keyframe, which may come in any order, twice, or after the robot has begun anew."""
        try:
            _, id, session = parse_keyframe_name(name)
        except UsageError as error:
            self._complain(str(error))
            return
        if session in self._ended:
            return
        if session != self._session:
            self._begin(session)
        if session and (id < self._next or id in self._above):
            return
        parts = self._parts.setdefault(name, {})
        parts[part] = message
        if len(parts) == 3:
            del self._parts[name]
            self._take(id, parts)
        while len(self._parts) > 100:  # they are sent again
            self._parts.pop(next(iter(self._parts)))

    def _begin(self, session: str) -> None:
        """A new drive. What the one before has sent is all that will ever come of it."""
        if self._session is not None:
            self._node.get_logger().warning(f"robot {self._robot or '/'} has started again: a new session of its own")
            self._ended.add(self._session)
            for id in sorted(self._above):
                self._add(id, self._above[id])
        self._session, self._next, self._last = session, 0, None
        self._parts, self._above = {}, {}

    def _take(self, id: int, parts: dict[str, Any]) -> None:
        """Hand on what is complete up to the first gap; without a session nothing is sent again: at once."""
        if not self._session:
            self._add(id, parts)
            return
        self._above[id] = parts
        while self._next in self._above:
            self._add(self._next, self._above.pop(self._next))
            self._next += 1

    def _add(self, id: int, parts: dict[str, Any]) -> None:
        try:
            points, descriptors = unpack_cloud(bytes(parts["cloud"].data)), descriptors_from_msg(parts["seen"])
            keyframe = keyframe_from(parts["pose"], points, self._robot, id, self._last, descriptors)
        except (UsageError, ValueError) as error:
            self._complain(f"keyframe {id}: {error}")
            return
        self._last = keyframe
        self._mapper.add(lambda: keyframe)

    def _complain(self, text: str) -> None:
        self._node.get_logger().error(f"robot {self._robot or '/'}: {text}", throttle_duration_sec=5)


def keyframe_from(
    pose: Odometry, points: Points, robot: str, id: int, before: Keyframe | None, descriptors: Descriptors | None = None
) -> Keyframe:
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
    return Keyframe(id, stamp_ns(pose.header), id, T_odom_kf, points, edge, robot, descriptors)
