# SPDX-License-Identifier: Apache-2.0
"""slam_node as a managed node, for Nav2's lifecycle manager and the like: the same node, step by step.

configure loads the network and opens the map; activate takes clouds; deactivate stops that, and keeps the map; cleanup
saves it. What each step creates, its way back destroys.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from dpm2_core.errors import Dpm2Error
from dpm2_ros.slam_node import SlamNode


class ManagedSlamNode(LifecycleNodeMixin, SlamNode):
    """See rclpy's `LifecycleNodeMixin` for the services."""

    def __init__(self) -> None:
        SlamNode.__init__(self, managed=True)
        LifecycleNodeMixin.__init__(self)
        self._made_before: dict[str, list[Any]] = {}
        change = self._service_change_state.callback

        def guarded(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except Exception as error:  # rclpy raises for a transition that there is not, and would not answer
                self.get_logger().warning(f"transition {request.transition.id}: {error}")
                response.success = False
                return response

        self._service_change_state.callback = guarded

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unconfigured to inactive."""
        return self._go("configure", self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to active."""
        return self._go("activate", self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Active to inactive."""
        return self._back("activate", self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to unconfigured."""
        return self._back("configure", self.cleanup)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From anywhere to the end."""
        return self._back("configure", self.close)

    def _go(self, step: str, work: Callable[[], None]) -> TransitionCallbackReturn:
        before = self._made_before[step] = self._entities()
        try:
            work()
        except Dpm2Error as error:
            self.get_logger().error(f"{step}: {error}")
            self._destroy_since(before)
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _back(self, step: str, work: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            work()
        except Dpm2Error as error:  # the map file has what could not be saved besides
            self.get_logger().error(f"{error}")
        self._destroy_since(self._made_before.get(step, self._entities()))
        return TransitionCallbackReturn.SUCCESS

    def _entities(self) -> list[Any]:
        return [*self.publishers, *self.subscriptions, *self.services, *self.clients, *self.timers]

    def _destroy_since(self, before: list[Any]) -> None:
        kept = {id(entity) for entity in before}
        ways = (
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.clients, self.destroy_client),
            (self.publishers, self.destroy_publisher),
        )
        for entities, destroy in ways:
            for entity in list(entities):
                if id(entity) not in kept:
                    destroy(entity)
