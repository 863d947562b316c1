# SPDX-License-Identifier: Apache-2.0
"""The thread of the map, and all that is published about the map; part of slam_node, and the core of mapper_node."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Edge, Keyframe
from dpm2_core.frame import Array
from dpm2_core.geometry.sampling import evenly
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_core.slam.mapping.occupancy import why_of_no_use
from dpm2_core.slam.mapping.occupancy_map import OccupancyMap
from dpm2_core.slam.store.map_cloud import map_cloud_in_steps
from dpm2_ros.active_map import ActiveMap
from dpm2_ros.conversions import cloud_to_msg, edge_to_msg, keyframe_name
from dpm2_ros.display import Display, grid_to_msg, loop_to_msg, path_to_msg, pose_graph_to_msg
from dpm2_ros.guard import GuardedNode, respond, slow_service
from dpm2_ros.runtime import lower_priority
from dpm2_ros.settings import NodeConfig
from dpm2_ros.subscriptions import LAST_ONE
from dpm2_ros.tf import TransformBroadcaster

LOOPS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""Not KEEP_ALL: for a subscriber that hangs, DDS would keep 5000 messages and then block on each later one, in vain."""
KEEP_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
"""For subscribers that must not miss a message."""
_GRID_PERIOD, _GRID_WORK = 0.5, 0.3  # s between two grids, and longest work on one
RETRY = 10.0
"""s after which an incomplete map file is written to again, also if no keyframe arrives."""
BEHIND = 10
"""Keyframes that may wait for the map before /diagnostics warns; a few are always in transit."""


class MapperThread:
    """Works on the map in its own thread, so that a loop search or an optimization never delays the odometry.

    Every method may be called from any thread, and returns at once, except `close`.

    Attributes:
        active: the map that it works on; other threads may read it.
        written: number of keyframes, of all that were ever added, that are in the map file (without one: in the map) or
            rejected. Those in `missing` are counted, too.
        tf: sends map -> odom.
        missing: number of each valid keyframe that could not be added to the map, to the reason, in words.
    """

    def __init__(self, node: GuardedNode, config: NodeConfig, robot: str) -> None:
        self._node, self._config, self._robot = node, config, robot
        self.active = ActiveMap(config, robot, node.get_logger())
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mapper", initializer=lower_priority)
        self._stamp = 0  # of the last keyframe, ns
        self._restarts: dict[str, Future[None]] = {}  # by robot: done once its odometry's restart is known here
        self._lock = threading.Lock()
        self._added = self._processed = self.written = 0  # keyframes
        self.missing: dict[int, str] = {}
        self._changes = self.keyframes
        ros = config.ros
        self.tf = TransformBroadcaster(
            node, ros.map_frame, ros.publish_tf_map, ros.invert_odom_tf and ros.odom_source == "own"
        )
        self._loop_candidates = node.create_publisher(DiagnosticArray, "dpm2/loop_candidates", LOOPS)
        self._loop_closures = node.create_publisher(Odometry, "dpm2/loop_closure", LOOPS)
        self._displays = [
            Display(node.create_publisher(kind, topic, LAST_ONE), period, make)
            for kind, topic, period, make in (
                (PathMsg, "dpm2/path", lambda: self._config.ros.path_period, self._path),
                (MarkerArray, "dpm2/pose_graph", lambda: self._config.ros.path_period, self._pose_graph),
                (PointCloud2, "dpm2/map", lambda: self._config.ros.map_period, self._map),
                (OccupancyGrid, "dpm2/grid", lambda: _GRID_PERIOD, self._grid),
            )
        ]
        self._drawn_grid: tuple[object, OccupancyMap] | None = None  # what the grid was drawn from, and the grid
        self._grid_problem = ""  # why the grid is unusable, in words
        self._settling: Future[None] = self._submit(lambda: None)  # done: no `_settle` is pending
        self._settled_at = time.monotonic()
        node.create_timer(0.1, self._update_displays)
        slow_service(node, Trigger, "~/save_map", self._on_save)

    @property
    def keyframes(self) -> int:
        """Number of keyframes in the map."""
        return len(self.active.mapper.keyframes)

    @property
    def waiting(self) -> int:
        """Number of keyframes that were added but are not in the map yet."""
        return self._added - self._processed

    @property
    def store_problem(self) -> str:
        """Why the map file is incomplete, in words; empty if it is complete, or if there is none."""
        return self.active.mapper.store_problem

    def broadcast(self, stamp: int, robot: str, odom_frame: str, T_own_odom: Array | None = None) -> None:
        """Send map -> odom of a robot, valid from that stamp (ns) on, if it is known.

        Args:
            T_own_odom: (4, 4) `odom_frame` in the odometry frame of the robot's keyframes; None: they are the same.
        """
        restarted = self._restarts.get(robot)
        T_map_odom = self.active.T_map_odom(robot) if restarted is None or restarted.done() else None
        if T_map_odom is not None:
            T = T_map_odom if T_own_odom is None else T_map_odom @ T_own_odom
            self.tf.send(T, stamp + self._config.ros.ahead, odom_frame)

    def add(self, make: Callable[[], Keyframe]) -> int:
        """Add the keyframe that `make`, called in the map's thread, returns; returns how many were added before it."""
        with self._lock:
            number, self._added = self._added, self._added + 1
            self._submit(lambda: self._process_keyframe(number, make))
        return number

    def hint(self, T_map_base: Array) -> str:
        """Set a prior for the robot's pose (4, 4), as from RViz; returns why it cannot be used, or an empty text."""
        localizer = self.active.localizer
        if localizer is None:
            return "a map is being built: a pose is used only in localization_mode"
        self._submit(lambda: localizer.hint(T_map_base))
        return ""

    def localise(self) -> Future[str]:
        """End the map that is being built, if any, and localize the robot in the map file; returns a message."""
        return self._thread.submit(self._change_map, self.active.localise)

    def load(self) -> Future[str]:
        """Localize the robot in the map that `ros.map_name` names, or in the same one again; returns a message."""
        if not (name := self._config.ros.map_name) and self.active.localizer is None:
            raise UsageError("no map is loaded: ros.map_name is empty, and localization_mode is off")
        return self._thread.submit(self._change_map, lambda: self.active.localise(name))

    def extend(self) -> Future[str]:
        """Extend the map in which the robot was localized by a new session; returns a message."""
        return self._thread.submit(self._change_map, self.active.extend)

    def apply(self, config: NodeConfig) -> None:
        """Apply settings that have changed while the node runs: those of the displays, and the map's name."""
        self._config = config
        self._changes += 1

    def restart(self, robot: str) -> None:
        """A robot's odometry has restarted: the map stays, the robot's pose in it is no longer known."""
        self._restarts[robot] = self._submit(lambda: self.active.restart(robot))

    async def before_reset(self, response: Trigger.Response, success_text: str) -> None:
        """Save the map, and fill the response of a reset service with `success_text`, or with why there is no reset."""
        await respond(self._node, self._thread.submit(self.active.keep), response)
        if response.success:
            response.message = "; ".join(filter(None, (response.message, success_text)))
        else:
            response.message = f"no reset: {response.message}"

    def reset(self) -> None:
        """The odometry restarts, and with it an empty map or the search for the robot; see `ActiveMap.reset`."""
        self._restarts[self._robot] = self._submit(lambda: self._change_map(self.active.reset))

    def close(self) -> None:
        """Add the keyframes that still wait, save the map, end the thread.

        Raises:
            Dpm2Error: the map could not be written, or its file is incomplete.
        """
        if self.waiting > BEHIND:
            self._node.get_logger().warning(
                f"{self.waiting} keyframes are still to be added to the map: this takes a while"
            )
        self._submit(self.active.finish)
        saved = self._thread.submit(self.active.save) if self.active.saves else None
        self._submit(self.active.close)
        self._thread.shutdown(wait=True)
        if saved is not None:
            try:
                self._node.get_logger().info(saved.result())
            except UsageError as error:
                self._node.get_logger().info(str(error))
            except Dpm2Error as error:
                if not self.store_problem:  # which is more serious, and raised below
                    raise
                self._node.get_logger().error(str(error))
        if self.store_problem:
            raise Dpm2Error(f"map file incomplete: {self.store_problem}")
        if self.active.file_problem and self.keyframes:  # such a map is in no folder either
            raise Dpm2Error(f"no map file: {self.active.file_problem}")

    def _submit(self, work: Callable[[], Any]) -> Future[Any]:
        future = self._thread.submit(work)
        future.add_done_callback(self._report)
        return future

    def _report(self, future: Future[Any]) -> None:
        error = future.exception()
        if isinstance(error, RejectedError):
            self._node.reject("map", error.reason, f"keyframe: {error}")
        elif isinstance(error, Dpm2Error):
            self._node.get_logger().error(str(error))
        elif error is not None:
            self._node.fail("mapper", error)

    def _change_map(self, work: Callable[[], Any]) -> Any:
        """Do work that changes the map; displays that are being built of the map before are dropped."""
        for display in self._displays:
            display.again()
        result = work()
        self._changes += 1
        return result

    def _settle(self) -> None:
        if self.active.settle():
            self._changes += 1
        if not self.store_problem:
            self.written = self._processed
        self._settled_at = time.monotonic()

    def _process_keyframe(self, number: int, make: Callable[[], Keyframe]) -> None:
        before, previous_problem = self.keyframes, self.store_problem
        try:
            self._add_keyframe(make())
        except RejectedError:
            raise
        except Exception as error:
            if self.keyframes == before and self.active.localizer is None:
                self.missing[number] = str(error) or type(error).__name__
            raise
        finally:
            self._processed += 1
            if not self.store_problem:
                self.written = self._processed
            elif not previous_problem:
                self._node.get_logger().error(f"map file incomplete: {self.store_problem}")

    def _add_keyframe(self, keyframe: Keyframe) -> None:
        loops = self.active.add(keyframe)
        if self.active.localizer is not None:
            return
        self._stamp = keyframe.stamp
        for loop in loops:
            self._publish_loop(loop, keyframe.stamp)
        self._changes += 1

    def _publish_loop(self, loop: Edge, stamp: int) -> None:
        ends = [self.active.mapper.keyframes[node] for node in (loop.from_node, loop.to_node)]
        names = [keyframe_name(keyframe.robot, keyframe.id) for keyframe in ends]
        self._loop_candidates.publish(loop_to_msg(loop, stamp, *names))
        if loop.ok:
            self._loop_closures.publish(edge_to_msg(loop.T_from_to, loop.covariance, stamp, *names))

    async def _on_save(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        save = partial(self.active.save, self._config.ros.map_name)
        await respond(self._node, self._thread.submit(self._change_map, save), response)
        return response

    def _update_displays(self) -> None:
        retry = bool(self.store_problem) and time.monotonic() - self._settled_at >= RETRY
        if self._settling.done() and (retry or self.active.mapper.graph.busy):
            self._settling = self._submit(self._settle)
        for display in self._displays:
            if display.due(self._changes):
                self._submit(display.publish)

    def _path(self) -> Any:
        mapper = self.active.mapper
        placed = mapper.placed
        stamps = [keyframe.stamp for keyframe, known in zip(mapper.keyframes, placed, strict=True) if known]
        return path_to_msg(mapper.poses[placed], stamps, self._config.ros.map_frame)

    def _pose_graph(self) -> Any:
        return pose_graph_to_msg(self.active.mapper, self._stamp, self._config.ros.map_frame)

    def _grid(self) -> Any:
        mapper, ros = self.active.mapper, self._config.ros
        source = (mapper, ros.grid, ros.grid_max_cells)
        if self._drawn_grid is None or self._drawn_grid[0] != source:
            self._drawn_grid = source, OccupancyMap(ros.grid, ros.grid_max_cells)
            self._grid_problem = ""
        grid = self._drawn_grid[1]
        if not mapper.update_grid(grid, _GRID_WORK):  # incomplete: of a loaded map, or after a loop in a large one
            self._displays[-1].again()
        before, self._grid_problem = self._grid_problem, why_of_no_use(mapper.poses[mapper.placed])
        if self._grid_problem and not before:
            self._node.get_logger().warning(f"dpm2/grid: {self._grid_problem}")
        return grid_to_msg(grid.grid(), self._stamp, ros.map_frame)

    def _map(self) -> Generator[None, None, PointCloud2]:
        """Built in steps, so that keyframes are processed in between."""
        mapper, ros = self.active.mapper, self._config.ros
        nodes, voxel = np.flatnonzero(mapper.placed).tolist(), self._config.slam.map.voxel
        points = yield from map_cloud_in_steps(mapper.clouds, mapper.poses, voxel, nodes)
        shown = points[evenly(len(points), ros.map_max_points)]
        return cloud_to_msg(shown, self._stamp, ros.map_frame)
