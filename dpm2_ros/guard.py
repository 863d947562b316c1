# SPDX-License-Identifier: Apache-2.0
"""A node that no message can crash: an unusable one is rejected, counted by its reason, and logged now and then."""

from __future__ import annotations

import functools
import threading
import time
import traceback
import types
from collections.abc import Callable, Generator
from concurrent.futures import Future
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from dpm2_core.errors import Dpm2Error, printable
from dpm2_core.slam.mapping.admission import RejectedError

_STEADY = Clock(clock_type=ClockType.STEADY_TIME)
_LOG_PERIOD = 5.0  # s between two log lines about the same reason
_MAX_KINDS = 200  # pairs of topic and reason; further ones are counted together
_MAX_LENGTH = 300  # characters of a log line, whatever is in the message


class GuardedNode(Node):
    """A node in which every callback of a subscription or a timer is guarded; services report errors in the response.

    Attributes:
        errors: number of unexpected exceptions: bugs, but the node continues.
        answering: number of service requests that are being processed in another thread.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self.errors = self.answering = 0
        self._rejections: dict[str, int] = {}
        self._logged_at: dict[str, float] = {}
        self._last_rejection = -float("inf")
        self._guard_lock = threading.Lock()
        super().__init__(name, **options)  # may subscribe to /clock

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *args: Any, **kw: Any
    ) -> Any:
        """As in `Node`; an exception in the callback rejects the message."""
        return super().create_subscription(msg_type, topic, self._guarded(callback, topic), *args, **kw)

    def create_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """As in `Node`, but it continues when /clock stops, as at the end of a bag; exceptions are counted."""
        return super().create_timer(period, self._guarded(callback, "timer"), clock=_STEADY)

    @property
    def rejections(self) -> dict[str, int]:
        """Number of messages that were rejected, by topic and reason."""
        with self._guard_lock:
            return dict(self._rejections)

    @property
    def since_rejection(self) -> float:
        """s since a message was rejected; inf if none was."""
        return time.monotonic() - self._last_rejection

    def reject(self, where: str, reason: str, text: str) -> None:
        """Count an unusable message, and log why it is unusable; any thread may call.

        Args:
            where: its topic.
            reason: one of a few fixed texts, never one from the message.
            text: one line; it may quote anything from the message.
        """
        kind = f"{where}: {reason}"
        with self._guard_lock:
            if kind not in self._rejections and len(self._rejections) >= _MAX_KINDS:
                kind = "others"
            self._rejections[kind] = self._rejections.get(kind, 0) + 1
            self._last_rejection = time.monotonic()
            is_due = self._log_is_due(kind)
        if is_due:
            self.get_logger().warning(f"{where}: rejected: {excerpt(text)}")

    def fail(self, where: str, error: BaseException) -> None:
        """Count and log an exception that is a bug; any thread may call."""
        with self._guard_lock:
            self.errors += 1
            is_due = len(self._logged_at) <= 2 * _MAX_KINDS and self._log_is_due(f"{where} {type(error).__name__}")
        if is_due:
            lines = "".join(traceback.format_exception(error))
            self.get_logger().error(f"{where}: {lines[-3000:]}")

    def _log_is_due(self, kind: str) -> bool:
        """Whether a log line of that kind is due; if so, it is noted as written. Call it with the lock."""
        now = time.monotonic()
        if now - self._logged_at.get(kind, -float("inf")) < _LOG_PERIOD:
            return False
        self._logged_at[kind] = now
        return True

    def _guarded(self, callback: Callable[..., Any], where: str) -> Callable[..., Any]:
        @functools.wraps(callback)  # rclpy inspects its signature
        def call(*args: Any) -> None:
            try:
                callback(*args)
            except RejectedError as error:
                self.reject(where, error.reason, str(error))
            except Dpm2Error as error:
                self.reject(where, "cannot be used", str(error))
            except Exception as error:
                self.fail(where, error)

        return call


def slow_service(node: Node, kind: type, name: str, callback: Callable[..., Any]) -> None:
    """Create a service whose callback awaits. It has its own group: other callbacks of a group wait until it ends."""
    node.create_service(kind, name, callback, callback_group=MutuallyExclusiveCallbackGroup())


def take_waiting(subscription: Any) -> None:
    """Call the callback, in this thread, with all messages that have arrived; an executor takes one of each topic."""
    handle = subscription.handle
    with handle:  # so that it is not destroyed in the meantime
        for _ in range(subscription.qos_profile.depth):
            if (taken := handle.take_message(subscription.msg_type, subscription.raw)) is None:
                return
            subscription.callback(taken[0])


async def respond(node: GuardedNode, work: Future[str], response: Any) -> None:
    """Fill the response of a service with the result of work in another thread: success, or why not."""
    node.answering += 1
    await until(work.done)
    node.answering -= 1
    try:
        response.success, response.message = True, work.result()
    except Dpm2Error as error:
        response.success, response.message = False, str(error)
    except Exception as error:  # a bug; the client must get a response nevertheless
        response.success, response.message = False, f"{type(error).__name__}: {error}"
        node.fail("service", error)


async def until(condition: Callable[[], bool]) -> None:
    """In a callback: let the executor run other callbacks until the condition is true."""
    while not condition():
        await _run_other_callbacks()


@types.coroutine
def _run_other_callbacks() -> Generator[None, None, None]:
    """Awaited in a callback: the executor runs other callbacks, then resumes this one."""
    yield


def excerpt(text: str, length: int = _MAX_LENGTH) -> str:
    """A text of unknown origin, safe for a terminal: unprintable characters are escaped, a long text is cut."""
    return printable(text if len(text) <= length else f"{text[:length]}...")
