# SPDX-License-Identifier: Apache-2.0
"""The mapper in a thread of its own, and all that it publishes; part of slam_node, and the core of mapper_node."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from dpm2_core.config import dump_settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import Array, Keyframe, LoopClosure, State
from dpm2_core.slam.loops.localiser import Localiser, Located
from dpm2_core.slam.map.mapper import Mapper
from dpm2_core.slam.map.session import open_for_localisation, open_session
from dpm2_core.slam.map.store import MapStore
from dpm2_core.slam.output import save_map
from dpm2_core.slam.system import make_localiser, make_mapper
from dpm2_ros.conversions import cloud_to_msg, edge_to_msg, keyframe_name
from dpm2_ros.display import Display, loop_to_msg, path_to_msg, pose_graph_to_msg
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
        graph = config.slam.pose_graph.model_copy(update={"background": True})  # gtsam holds Python's lock
        config = config.model_copy(update={"slam": config.slam.model_copy(update={"pose_graph": graph})})
        self._node, self._config, self._robot = node, config, robot
        self._store: MapStore | None = None
        self._localiser: Localiser | None = None
        self._located: Located | None = None
        self._map_file = Path(config.ros.map_file)  # written, or to be found in
        self._mapper = self._load() if config.ros.localization_mode else self._new_mapper()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mapper")
        self._T_map_odom: dict[str, Array] = {}  # by robot
        self._stamp = 0  # of the last keyframe, ns
        self._last: Future[None] | None = None  # of the keyframes taken in
        self._changes = len(self._mapper.keyframes)
        self._displays: list[Display] = []
        ros = config.ros
        self._tf = TransformBroadcaster(node, ros.map_frame, ros.publish_tf_map)
        self._loop_candidates = node.create_publisher(DiagnosticArray, "dpm2/loop_candidates", KEEP_ALL)
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

    @property
    def localising(self) -> bool:
        """Whether the map stays as it is."""
        return self._localiser is not None

    @property
    def located(self) -> Located | None:
        """What became of the last keyframe in a map that stays as it is."""
        return self._located

    def state(self, odometry: State) -> State:
        """That of the robot: of its odometry, or, where that is well, of its place in a map that stays as it is."""
        localiser = self._localiser
        if localiser is None or odometry in (State.LOST, State.INITIALISING) or localiser.state is State.TRACKING:
            return odometry
        return localiser.state

    def wants_keyframe(self, stamp: int) -> bool:
        """Whether one is looked for that the odometry would not make of its own (ns)."""
        idle = self._last is None or self._last.done()
        return self._localiser is not None and idle and self._localiser.wants(stamp)

    def broadcast(self, stamp: int, robot: str, odom_frame: str) -> None:
        """Send map -> odom of a robot, valid at that stamp (ns), if it is known."""
        localiser = self._localiser
        if localiser is None:
            T_map_odom = self._T_map_odom.get(robot)
            if T_map_odom is None and robot == self._robot and not self._T_map_odom:
                T_map_odom = self._mapper.T_map_odom  # nobody has sent a keyframe
        else:
            T_map_odom = localiser.T_map_odom if localiser.state.located else None
        if T_map_odom is not None:
            self._tf.send(T_map_odom, stamp, odom_frame)

    def add(self, make: Callable[[], Keyframe]) -> None:
        """Take in the keyframe that `make`, called in this thread, returns."""
        self._last = self._submit(lambda: self._add(make()) if self._localiser is None else self._locate(make()))

    def hint(self, T_map_base: Array) -> str:
        """The robot is about there (4, 4), somebody says; returns why that is of no use, if it is not."""
        localiser = self._localiser
        if localiser is None:
            return "a map is being made: a pose is of use only with localization_mode"
        self._submit(lambda: localiser.hint(T_map_base))
        return ""

    def localise(self) -> Future[str]:
        """End the map that is being made, if one is, and look for the robot in the map file; the answer in words."""
        return self._thread.submit(self._localise)

    def extend(self) -> Future[str]:
        """Let the map grow from now on: that in which the robot was looked for, by a new session."""
        return self._thread.submit(self._extend)

    def reset(self, save: bool) -> None:
        """Begin an empty map; `save` keeps the present one on disk."""
        if self._localiser is not None:
            self._submit(self._localiser.restart)
            return
        if save and self.directory is not None:
            self._submit(self._save)
        self._submit(self._reset)

    def close(self) -> None:
        """Finish what is waiting, save the map, end the thread.

        Raises:
            Dpm2Error: the map could not be written.
        """
        last: Future[str] | None = None
        if self._localiser is None:
            self._submit(lambda: self._mapper.finish())
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

    def _locate(self, keyframe: Keyframe) -> None:
        """In a map that stays as it is."""
        assert self._localiser is not None
        before = self._localiser.state
        located = self._located = self._localiser.add(keyframe)
        if located.state is before:
            return
        if located.jumped:
            x, y, z = located.T_map_kf[:3, 3].tolist()
            kind = "kidnapped; found again" if before.located else "found"
            self._node.get_logger().info(f"{kind} at ({x:.1f}, {y:.1f}, {z:.1f}) m of {self._config.ros.map_frame}")
        elif located.state in (State.LOST, State.DEGRADED):
            self._node.get_logger().warning(f"{located.state}: {located.registration.reason}")

    def _add(self, keyframe: Keyframe) -> None:
        self._stamp, before = keyframe.stamp, self._T_map_odom.keys()
        for closure in self._mapper.add(keyframe):
            self._publish_loop(closure, keyframe.stamp)
        placed = {robot: self._mapper.T_map_odom_of(robot) for robot in self._mapper.robots}
        self._T_map_odom = {robot: T for robot, T in placed.items() if T is not None}
        for robot in self._T_map_odom.keys() - before:
            self._node.get_logger().info(f"robot {robot or '/'}: its place in the map is known")
        self._changes += 1

    def _publish_loop(self, closure: LoopClosure, stamp: int) -> None:
        found = closure.registration
        ends = (closure.from_robot, closure.from_id), (closure.to_robot, closure.to_id)
        names = [keyframe_name(robot, id) for robot, id in ends]
        self._loop_candidates.publish(loop_to_msg(closure, stamp, *names))
        if found.ok:
            self._loop_closures.publish(edge_to_msg(found.T_target_source, found.covariance, stamp, *names))

    def _reset(self) -> None:
        self._finish_file()
        self._mapper, self._T_map_odom = self._new_mapper(), {}
        self._changes += 1

    def _new_mapper(self) -> Mapper:
        """An empty one, with a map file if there is to be one. A file that cannot be made is no reason not to map."""
        ros = self._config.ros
        if ros.map_file:
            path = free_path(Path(ros.map_file), self._robot)
            try:
                self._store = open_session(path, self._config.slam, dump_settings(self._config), resume=False)
                self._map_file = path
            except Dpm2Error as error:
                self._node.get_logger().error(f"no map file: {error}")
        return make_mapper(self._config.slam, self._store)

    def _load(self) -> Mapper:
        """The map file, to find oneself in.

        Raises:
            UsageError: there is none that would serve.
        """
        if not self._config.ros.map_file:
            raise UsageError("no map to find oneself in: ros.map_file is empty")
        store = open_for_localisation(self._map_file, self._config.slam)
        try:
            mapper = make_mapper(self._config.slam, store)
            localiser = make_localiser(self._config.slam, mapper)
        except BaseException:
            store.close()
            raise
        self._finish_file()
        self._store, self._localiser, self._located = store, localiser, None
        return mapper

    def _localise(self) -> str:
        if self._localiser is None:
            if self._store is None:
                raise UsageError("no map to find oneself in: ros.map_file is empty, or could not be written")
            self._finish_file()  # what is in memory is in the file
        try:
            self._mapper = self._load()
        except Dpm2Error:
            if self._localiser is None:  # the drive goes on as before
                self._mapper = self._resumed()
            raise
        self._changes += 1
        return f"looking for the robot in {self._map_file}, {self.keyframes} keyframes"

    def _extend(self) -> str:
        localiser = self._localiser
        if localiser is None:
            return f"a map is being made already, {self.keyframes} keyframes"
        if not localiser.state.located:
            raise UsageError(f"not extended: the robot is {localiser.state} in {self._map_file}")
        assert self._store is not None
        self._store.close()
        self._store, self._mapper = None, self._resumed()
        self._mapper.start_session(localiser.T_map_odom)
        self._localiser = self._located = None
        return f"{self._map_file} grows by a new session"

    def _resumed(self) -> Mapper:
        """The mapper that goes on with the map file."""
        self._store = open_session(self._map_file, self._config.slam, dump_settings(self._config), resume=True)
        return make_mapper(self._config.slam, self._store)

    def _finish_file(self) -> None:
        if self._localiser is None:
            self._mapper.finish()
        if self._store is not None:
            self._store.close()
            self._store = None

    def _save(self) -> str:
        if self.directory is None:
            raise UsageError("no map is saved: ros.map_directory is empty")
        if self._localiser is not None:
            raise UsageError("no map is saved: in localization_mode the map stays as it is, in its file")
        if not self._mapper.keyframes:
            raise UsageError("no map is saved: there is no keyframe yet")
        try:
            save_map(self._mapper, self.directory)
        except OSError as error:
            raise Dpm2Error(f"{self.directory}: no map saved: {error.strerror}") from None
        return f"map of {self.keyframes} keyframes saved in {self.directory.resolve()}"

    async def _on_save(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        await answer(self._thread.submit(self._save), response)
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


async def answer(work: Future[str], response: Any) -> None:
    """Fill the response of a service with what comes of work in another thread: success, or why not, in words."""
    while not work.done():
        await _OtherCallbacks()
    try:
        response.success, response.message = True, work.result()
    except Dpm2Error as error:
        response.success, response.message = False, str(error)


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
