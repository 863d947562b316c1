# SPDX-License-Identifier: Apache-2.0
"""A lifecycle manager such as Nav2's, for tests of managed nodes."""

from __future__ import annotations

from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState


class Manager:
    """What a lifecycle manager does with a node, over its services."""

    def __init__(self, harness: Any, name: str) -> None:
        self._harness = harness
        self._change = harness.node.create_client(ChangeState, f"{name}/change_state")
        self._state = harness.node.create_client(GetState, f"{name}/get_state")

    def _call(self, client: Any, request: Any) -> Any:
        self._harness.wait(client.service_is_ready, client.srv_name)
        future = client.call_async(request)
        self._harness.wait(future.done, client.srv_name)
        return future.result()

    def change(self, *transitions: int) -> bool:
        """Whether all of them were made."""
        requests = (ChangeState.Request(transition=Transition(id=transition)) for transition in transitions)
        return all(bool(self._call(self._change, request).success) for request in requests)

    @property
    def state(self) -> str:
        """Its label."""
        return str(self._call(self._state, GetState.Request()).current_state.label)
