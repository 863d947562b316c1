# SPDX-License-Identifier: Apache-2.0
"""A lifecycle manager such as Nav2's, for tests of managed nodes."""

from __future__ import annotations

from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState


class Manager:
    """Requests of a lifecycle manager to a node, over its services."""

    def __init__(self, harness: Any, name: str) -> None:
        self._harness, self._name = harness, name

    def change(self, *transitions: int) -> bool:
        """Request the transitions. Returns whether all of them succeeded."""
        made = (Transition(id=transition) for transition in transitions)
        return all(self._call(ChangeState, "change_state", transition=one).success for one in made)

    @property
    def state(self) -> str:
        """Label of the node's state."""
        return str(self._call(GetState, "get_state").current_state.label)

    def _call(self, kind: type, service: str, **fields: Any) -> Any:
        return self._harness.call(kind, f"{self._name}/{service}", **fields)
