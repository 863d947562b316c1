# SPDX-License-Identifier: Apache-2.0
"""The common part of slam_node and mapper_node: two steps, configure and activate, and how they are undone.

A plain node takes both steps when it is created. A managed one (`--lifecycle`) takes each when Nav2's lifecycle manager
or the like requests it, by the services of rclpy's `LifecycleNodeMixin`. To undo a step ends all that it has created.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from lifecycle_msgs.msg import Transition
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.time_source import CLOCK_TOPIC

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_ros.guard import GuardedNode, until
from dpm2_ros.mapping import MapperThread
from dpm2_ros.parameters import follow_changes, load_parameters
from dpm2_ros.settings import NodeConfig

_KEEP_SERVICES = (Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE)
"""Transitions that destroy no service."""
_Snapshot = tuple[set[int], set[str]]
"""The entities of ROS, by their id(), and the names of the attributes that a node had at a time."""


class ManagedNode(LifecycleNodeMixin, GuardedNode):
    """A node with the settings of all nodes, and with a map if it opens one.

    A subclass defines `configure` and `activate`, and calls `start` at the end of `__init__`.

    Raises:
        UsageError: a parameter that is not allowed.
    """

    _mapper: MapperThread | None = None  # once configured

    def __init__(self, name: str) -> None:
        GuardedNode.__init__(self, name, automatically_declare_parameters_from_overrides=True)
        self._config, self._robot = load_parameters(self), self.get_namespace().strip("/")
        self._steps_taken: list[tuple[_Snapshot, ExitStack]] = []  # steps: what existed before each, and how to undo it
        follow_changes(self, self._config, self._apply_config)

    def declare_parameters(self, namespace: str, parameters: Any, ignore_override: bool = False) -> Any:
        """As in `Node`, which declares all given parameters. ROS reads an empty list as no value, which has no type.

        Raises:
            UsageError: a parameter without a value.
        """
        for name, value, descriptor in parameters:
            if value is None and not descriptor.dynamic_typing:
                raise UsageError(f"ROS parameter: {name}: want a value, got an empty list")
        return super().declare_parameters(namespace, parameters, ignore_override)

    def configure(self, undo: ExitStack) -> None:
        """Load the network, open the map, announce what will be published.

        Args:
            undo: receives the callbacks of the cleanup, which also run if this fails half-way; topics, services and
                timers need none.

        Raises:
            UsageError, Dpm2Error: the step is not possible.
        """
        raise NotImplementedError

    def activate(self, undo: ExitStack) -> None:
        """Subscribe, and begin to work.

        Args:
            undo: receives the callbacks of the deactivation, in the same way.

        Raises:
            UsageError, Dpm2Error: the step is not possible.
        """
        raise NotImplementedError

    def start(self, managed: bool) -> None:
        """Take both steps; `managed`: when they are requested.

        Raises:
            UsageError, Dpm2Error: a step is not possible. The node is closed.
        """
        if managed:
            self._create_transition_services()
            return
        try:
            self._take_step(self.configure)
            self._take_step(self.activate)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End everything, whatever is in progress; the map is saved.

        Raises:
            Dpm2Error: the map could not be written.
        """
        steps, self._steps_taken = self._steps_taken, []
        with ExitStack() as stack:
            for _, undo in steps:
                stack.push(undo)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unconfigured to inactive."""
        return self._run_step(self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to active."""
        return self._run_step(self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Active to inactive: the map stays open."""
        return self._undo_to(1)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """To unconfigured, also after a bug in a step, or to finalized: the map is saved."""
        return self._undo_to(0)

    on_shutdown = on_error = on_cleanup

    def _open_map(self, undo: ExitStack) -> MapperThread:
        """Open the map of this node, until the cleanup."""
        self._mapper = mapper = MapperThread(self, self._config, self._robot)
        undo.callback(mapper.close)
        return mapper

    def _apply_config(self, config: NodeConfig) -> None:
        """Apply parameters that have changed while the node runs."""
        self._config = config
        if self._mapper is not None:
            self._mapper.apply(config)

    def _create_transition_services(self) -> None:
        # In a group of its own: while a transition waits, the other callbacks of its group wait, too.
        LifecycleNodeMixin.__init__(self, callback_group=MutuallyExclusiveCallbackGroup())
        change_state = self._service_change_state.callback

        async def guarded(request: Any, response: Any) -> Any:
            if request.transition.id not in _KEEP_SERVICES:  # a destroyed service cannot respond any more
                await until(lambda: not self.answering)
            try:
                return change_state(request, response)
            except Exception as error:  # rclpy raises for an unknown transition, and would not respond
                self.get_logger().warning(f"transition {request.transition.id}: {error}")
                response.success = False
                return response

        self._service_change_state.callback = guarded

    def _take_step(self, step: Callable[[ExitStack], None]) -> None:
        before = self._snapshot()
        with ExitStack() as undo:
            step(undo)
            self._steps_taken.append((before, undo.pop_all()))

    def _run_step(self, step: Callable[[ExitStack], None]) -> TransitionCallbackReturn:
        before = self._snapshot()
        try:
            self._take_step(step)
        except Dpm2Error as error:
            self.get_logger().error(f"{step.__name__}: {error}")
            self._destroy_since(before)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.fail(step.__name__, error)
            self._destroy_since(before)
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _undo_to(self, steps: int) -> TransitionCallbackReturn:
        """Undo all but the first `steps` steps."""
        while len(self._steps_taken) > steps:
            before, undo = self._steps_taken.pop()
            try:
                undo.close()
            except Dpm2Error as error:  # the rest is undone nevertheless: what could be saved is saved
                self.get_logger().error(f"{error}")
            except Exception as error:
                self.fail("transition", error)
            self._destroy_since(before)
        return TransitionCallbackReturn.SUCCESS

    def _snapshot(self) -> _Snapshot:
        entities = (*self.publishers, *self.subscriptions, *self.services, *self.clients, *self.timers)
        return {id(entity) for entity in entities}, set(vars(self))

    def _destroy_since(self, before: _Snapshot) -> None:
        """Destroy the entities of ROS that were created since, and delete the attributes: a map is large."""
        kept, names = before
        destroyers = (
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.clients, self.destroy_client),
            (self.publishers, self.destroy_publisher),
        )
        for entities, destroy in destroyers:
            for entity in list(entities):
                # Not the subscription to /clock, if use_sim_time was set since: the node needs it in every state.
                if id(entity) not in kept and getattr(entity, "topic_name", "") != CLOCK_TOPIC:
                    destroy(entity)
        for name in vars(self).keys() - names:
            delattr(self, name)
