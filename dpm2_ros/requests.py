# SPDX-License-Identifier: Apache-2.0
"""The requests to slam_node by services and from RViz: reset, another map, initial pose."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_srvs.srv import SetBool, Trigger

from dpm2_core.data.naming import frame_name
from dpm2_core.errors import UsageError
from dpm2_ros.base_frame import BaseFrame
from dpm2_ros.checks import checked_pose
from dpm2_ros.guard import GuardedNode, respond, slow_service
from dpm2_ros.mapping import MapperThread


class Requests:
    """The services of slam_node, and `initialpose`.

    Attributes:
        reset: set once a reset is requested and the map is saved.
    """

    def __init__(self, node: GuardedNode, mapper: MapperThread | None, base: BaseFrame, map_frame: str) -> None:
        """`mapper`: None with a separate mapper_node."""
        self._node, self._mapper, self._base, self._map_frame = node, mapper, base, map_frame
        self.reset = threading.Event()
        slow_service(node, Trigger, "~/reset", self._on_reset)
        slow_service(node, Trigger, "~/load_map", self._on_load_map)
        slow_service(node, SetBool, "~/localization_mode", self._on_localization_mode)
        node.create_subscription(PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, 10)

    async def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._mapper is not None:
            begins = "map" if self._mapper.active.localizer is None else "the search for its place in the map"
            await self._mapper.before_reset(response, f"odometry and {begins} start again with the next cloud")
        else:
            begins = "odometry starts again with the next cloud, and its keyframes as a new session of the mapper's map"
            response.success, response.message = True, begins
        if response.success:
            self.reset.set()
        return response

    async def _on_load_map(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return await self._run_in_mapper_thread(MapperThread.load, response)

    async def _on_localization_mode(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        return await self._run_in_mapper_thread(
            MapperThread.localise if request.data else MapperThread.extend, response
        )

    async def _run_in_mapper_thread(self, work: Callable[[MapperThread], Future[str]], response: Any) -> Any:
        """The response, filled with the result of `work` in the mapper's thread."""
        if self._mapper is None:
            response.success, response.message = False, "the mapper is another node's: ros.embed_mapper is off"
            return response
        try:
            await respond(self._node, work(self._mapper), response)
        except UsageError as error:
            response.success, response.message = False, str(error)
        return response

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        frame, requested = frame_name(message.header.frame_id), self._map_frame
        if frame != requested:
            raise UsageError(f"initialpose not used: want it in frame {requested}, not in {frame[:80]!r}")
        T_map_start = checked_pose(message.pose.pose) @ self._base.T_base_start
        if problem := "no map here" if self._mapper is None else self._mapper.hint(T_map_start):
            raise UsageError(f"initialpose not used: {problem}")
