# SPDX-License-Identifier: Apache-2.0
"""The mapper in a thread of its own, and all that it publishes; part of slam_node, and the core of mapper_node."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from dpm2_core.config import dump_settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import Keyframe
from dpm2_core.slam.map.mapper import Mapper
from dpm2_core.slam.map.session import open_session
from dpm2_core.slam.map.store import MapStore
from dpm2_core.slam.output import save_map
from dpm2_core.slam.system import make_mapper
from dpm2_ros.conversions import cloud_to_msg, edge_to_msg, keyframe_name
from dpm2_ros.display import path_to_msg, pose_graph_to_msg
from dpm2_ros.settings import NodeConfig
from dpm2_ros.subscriptions import STEADY
from dpm2_ros.tf import TransformBroadcaster

KEEP_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
LAST_ONE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class MapperThread:
    """Runs the core's mapper so that a loop search or an optimisation never delays the odometry.

    Every method may be called from any thread, and returns at once.
    """

    def __init__(self, node: Node, config: NodeConfig, robot: str) -> None:
        self._node, self._config, self._robot = node, config, robot
        self._store: MapStore | None = None
        self._mapper = self._new_mapper()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mapper")
        self._stamp = 0  # of the last keyframe, ns
        self._changes = 0
        self._displays: list[Display] = []
        ros = config.ros
        self._tf = TransformBroadcaster(node, ros.map_frame, ros.publish_tf_map)
        self._loop_closures = node.create_publisher(Odometry, "dpm2/loop_closure", KEEP_ALL)
        for kind, topic, period, make in (
            (PathMsg, "dpm2/path", ros.path_period, self._path),
            (MarkerArray, "dpm2/pose_graph", ros.path_period, self._pose_graph),
            (PointCloud2, "dpm2/map", ros.map_period, self._map),
        ):
            self._displays.append(Display(node.create_publisher(kind, topic, LAST_ONE), period, make))
        node.create_timer(0.1, self._show, clock=STEADY)
        node.create_service(Trigger, "~/save_map", self._on_save)

    @property
    def keyframes(self) -> int:
        """How many there are."""
        return len(self._mapper.keyframes)

    @property
    def loops(self) -> tuple[int, int]:
        """Loops accepted, and loops tried."""
        closures = list(self._mapper.closures)
        return sum(closure.registration.ok for closure in closures), len(closures)

    @property
    def store_problem(self) -> str:
        """Why the map file is behind, in words; empty when it is not, or when there is none."""
        return self._mapper.store_problem

    @property
    def directory(self) -> Path | None:
        """Where the map is saved; None where it is not."""
        base = self._config.ros.map_directory
        return Path(base) / self._robot if base else None

    def broadcast(self, stamp: int) -> None:
        """Send map -> odom, valid at that stamp (ns)."""
        self._tf.send(self._mapper.T_map_odom, stamp, self._config.ros.odom_frame)

    def add(self, keyframe: Keyframe) -> None:
        """Take a keyframe in."""
        self._submit(lambda: self._add(keyframe))

    def reset(self, save: bool) -> None:
        """Begin an empty map; `save` keeps the present one on disk."""
        if save and self.directory is not None:
            self._submit(self._save)
        self._submit(self._reset)

    def close(self) -> None:
        """Finish what is waiting, save the map, end the thread.

        Raises:
            Dpm2Error: the map could not be written.
        """
        last: Future[str] | None = None
        if self.directory is not None:
            last = self._thread.submit(self._save)
        self._submit(self._finish_file)
        self._thread.shutdown(wait=True)
        if last is not None:
            try:
                self._node.get_logger().info(last.result())
            except UsageError as error:
                self._node.get_logger().info(str(error))

    def _submit(self, work: Callable[[], Any]) -> Future[Any]:
        future = self._thread.submit(work)
        future.add_done_callback(self._report)
        return future

    def _report(self, future: Future[Any]) -> None:
        error = future.exception()
        if isinstance(error, Dpm2Error):
            self._node.get_logger().error(str(error))
        elif error is not None:
            self._node.get_logger().error(f"mapper: {type(error).__name__}: {error}")

    def _add(self, keyframe: Keyframe) -> None:
        self._stamp = keyframe.stamp
        for closure in self._mapper.add(keyframe):
            found = closure.registration
            if found.ok:
                names = (keyframe_name(self._robot, id) for id in (closure.from_id, closure.to_id))
                self._loop_closures.publish(
                    edge_to_msg(found.T_target_source, found.covariance, keyframe.stamp, *names)
                )
        self._changes += 1

    def _reset(self) -> None:
        self._finish_file()
        self._mapper = self._new_mapper()
        self._changes += 1

    def _new_mapper(self) -> Mapper:
        """An empty one, with a map file if there is to be one. A file that cannot be made is no reason not to map."""
        ros = self._config.ros
        if ros.map_file:
            path = free_path(Path(ros.map_file), self._robot)
            try:
                self._store = open_session(path, self._config.slam, dump_settings(self._config), resume=False)
            except Dpm2Error as error:
                self._node.get_logger().error(f"no map file: {error}")
        return make_mapper(self._config.slam, self._store)

    def _finish_file(self) -> None:
        if self._store is not None:
            self._mapper.finish()
            self._store.close()
            self._store = None

    def _save(self) -> str:
        if self.directory is None:
            raise UsageError("no map is saved: ros.map_directory is empty")
        if not self._mapper.keyframes:
            raise UsageError("no map is saved: there is no keyframe yet")
        try:
            save_map(self._mapper, self.directory)
        except OSError as error:
            raise Dpm2Error(f"{self.directory}: no map saved: {error.strerror}") from None
        return f"map of {self.keyframes} keyframes saved in {self.directory.resolve()}"

    async def _on_save(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        future = self._thread.submit(self._save)
        while not future.done():
            await _OtherCallbacks()
        try:
            response.success, response.message = True, future.result()
        except Dpm2Error as error:
            response.success, response.message = False, str(error)
        return response

    def _show(self) -> None:
        for display in self._displays:
            if display.due(self._changes):
                self._submit(display.publish)

    def _path(self) -> Any:
        stamps = [keyframe.stamp for keyframe in self._mapper.keyframes]
        return path_to_msg(self._mapper.poses, stamps, self._config.ros.map_frame)

    def _pose_graph(self) -> Any:
        return pose_graph_to_msg(self._mapper, self._stamp, self._config.ros.map_frame)

    def _map(self) -> Any:
        points = self._mapper.cloud()
        most = self._config.ros.map_max_points
        if len(points) > most:
            points = points[np.linspace(0, len(points) - 1, most).astype(np.intp)]
        return cloud_to_msg(points, self._stamp, self._config.ros.map_frame)


class Display:
    """Something large that is built only for those who look: when somebody listens, it has changed, and it is time."""

    def __init__(self, publisher: Any, period: float, make: Callable[[], Any]) -> None:
        self._publisher, self._period, self._make = publisher, period, make
        self._shown = 0
        self._last = -np.inf
        self._working = False

    def due(self, changes: int) -> bool:
        """Whether to publish now; if so, `publish` is expected to follow."""
        waited = time.monotonic() - self._last >= self._period
        if self._working or changes == self._shown or not waited or not self._publisher.get_subscription_count():
            return False
        self._working, self._shown, self._last = True, changes, time.monotonic()
        return True

    def publish(self) -> None:
        """Build and send it."""
        try:
            self._publisher.publish(self._make())
        finally:
            self._working = False


class _OtherCallbacks:
    """Awaited in a callback: the executor goes on with others, and comes back."""

    def __await__(self) -> Any:
        yield


def free_path(path: Path, robot: str) -> Path:
    """The path with the robot's name, and with -2, -3, ... while there is a file of that name."""
    stem = f"{path.stem}_{robot.replace('/', '_')}" if robot else path.stem
    names = (stem if n == 1 else f"{stem}-{n}" for n in count(1))
    return next(p for name in names if not (p := path.with_name(name + path.suffix)).exists())


def robot_name(node: Node) -> str:
    """The namespace without slashes at its ends: what keyframes and folders are called after."""
    return node.get_namespace().strip("/")
