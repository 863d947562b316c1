# SPDX-License-Identifier: Apache-2.0
"""Nodes in this process, next to a node of the test, over real DDS."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from dpm2_ros.runtime import end_ros, ros_context
from tools.replay import ros_environment, start


class Harness:
    """Nodes under test and a tester node, spun by one thread."""

    def __init__(self, parameters: Sequence[str], domain: int, namespace: str) -> None:
        # By default without the network, which takes most of the time: how a node handles scans and keyframes is the
        # same. Drives through nodes with their default settings: test_replay.py and test_lockstep.py.
        quick = ("ros.map_directory:=''", "slam.registration:=geometric", "slam.loops.descriptors:=false")
        pairs = [part for pair in (*quick, *parameters) for part in ("-p", pair)]
        remap = ["-r", f"__ns:={namespace}"] if namespace else []
        ros_context(["--ros-args", *pairs, *remap], domain)
        self.node = rclpy.create_node("tester", use_global_arguments=False)
        self.received: dict[str, list[Any]] = {}
        self._clients: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._closing: list[Any] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        while not self._ended.is_set():
            self._executor.spin_once(timeout_sec=1.0)  # added nodes and the end wake it up

    def add(self, node: Node) -> Any:
        """Spin a node, and close it at the end."""
        self._executor.add_node(node)
        self._executor.wake()
        self._closing.append(node)
        return node

    def remove(self, node: Node) -> None:
        """Close a node under test before the end."""
        self._closing.remove(node)

        def end() -> None:
            self._executor.remove_node(node)
            node.close()  # type: ignore[attr-defined]
            node.destroy_node()

        self._between_waits(end, f"the end of {node.get_name()}")

    def start(self, name: str, arguments: Sequence[str], log: Path, **variables: str) -> subprocess.Popen[bytes]:
        """Start an executable as a process that communicates with these nodes. It is killed at the end."""
        environment = ros_environment(self.node.context.get_domain_id()) | variables
        self._processes.append(start(name, arguments, environment, log))
        return self._processes[-1]

    def hear(self, kind: type, topic: str, qos: Any = 100) -> list[Any]:
        """Subscribe to a topic; the list receives the messages as they arrive."""
        messages = self.received.setdefault(topic, [])
        self.node.create_subscription(kind, topic, messages.append, qos)
        self._executor.wake()
        return messages

    def found_by(self, node: Node, topic: str) -> bool:
        """Whether a node has discovered the tester's subscription; it may have its own subscription."""
        return any(one.node_name == self.node.get_name() for one in node.get_subscriptions_info_by_topic(topic))

    def publisher(self, kind: type, topic: str, reliable: bool = True, latched: bool = False) -> Any:
        """A publisher."""
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        return self.node.create_publisher(
            kind, topic, QoSProfile(depth=50, reliability=reliability, durability=durability)
        )

    def call(self, kind: type, name: str, **fields: Any) -> Any:
        """Call a node's service and return the reply. The request is sent once: it need not be idempotent.

        Fast DDS drops a reply if the server has not discovered the client's reader within 0.1 s, which may happen on a
        busy machine. The client is not informed. Readers are announced in the order of their creation: once the node
        has replied to a later one, it has discovered the first one.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
            probe = self.node.create_client(GetParameters, f"{name.rpartition('/')[0]}/get_parameters")
            self._reply(probe, GetParameters.Request(), again=3.0)
        return self._reply(self._clients[name], kind.Request(**fields))

    def _reply(self, client: Any, request: Any, again: float = float("inf")) -> Any:
        """`again`: the request is repeated after this time without a reply, s."""
        self.wait(client.service_is_ready, client.srv_name)
        sent, futures = 0.0, list[Any]()

        def replies() -> list[Any]:
            nonlocal sent
            if not futures or time.monotonic() - sent > again:
                sent = time.monotonic()
                futures.append(client.call_async(request))
            return [future.result() for future in futures if future.done()]

        self.wait(replies, f"the reply of {client.srv_name}")
        return replies()[0]

    @property
    def diagnostics(self) -> list[DiagnosticArray]:
        """Messages of /diagnostics since the first use of this property."""
        topic = "/diagnostics"
        return self.received[topic] if topic in self.received else self.hear(DiagnosticArray, topic)

    def status(
        self, part: str, condition: Callable[[DiagnosticStatus], Any] = bool, since: int | None = None
    ) -> DiagnosticStatus:
        """The first status that fulfills the condition; waits for it.

        A message may describe the time before the last step of a test: the condition must express what the test waits
        for.

        Args:
            part: end of the status's name. since: number of the first message that counts; None: the last one received.
        """
        heard = self.diagnostics
        begin = max(len(heard) - 1, 0) if since is None else since
        last, found = "none", list[DiagnosticStatus]()

        def look() -> bool:
            nonlocal begin, last
            for message in heard[begin:]:
                begin += 1
                statuses = [status for status in message.status if status.name.endswith(part)]
                found.extend(filter(condition, statuses))
                last = repr(statuses[-1]) if statuses else last
            return bool(found)

        try:
            self.wait(look, f"a status of {part}")
        except AssertionError as error:
            raise AssertionError(f"{error}; the last: {last}") from None
        return found[0]

    def find(self, name: str) -> None:
        """Wait until a node in another process has discovered all subscriptions here; its earlier messages are lost.

        To check this, a reader that was announced after the others must receive its diagnostics.
        """
        told: list[str] = []
        add = lambda message: told.extend(status.name for status in message.status)  # noqa: E731
        reader = self.node.create_subscription(DiagnosticArray, "/diagnostics", add, 10)
        self._executor.wake()
        self.wait(lambda: any(one.startswith(f"{name}: ") for one in told), f"the diagnostics of {name}")
        self.destroy(reader)

    def destroy(self, entity: Any) -> None:
        """Destroy a publisher or subscription of the tester."""
        is_publisher = entity in list(self.node.publishers)
        destroy = self.node.destroy_publisher if is_publisher else self.node.destroy_subscription
        self._between_waits(partial(destroy, entity), "the end of a publisher or subscription")

    def _between_waits(self, work: Callable[[], Any], what: str) -> None:
        """Do the work in the spinning thread, between two of its waits. rclpy raises in this thread if it is about to
        wait for an entity that another thread destroys. And no callback may use a node that another thread is
        closing."""
        done = Future[Any]()

        def run() -> None:
            try:
                done.set_result(work())
            except BaseException as error:
                done.set_exception(error)

        self._executor.create_task(run)
        self.wait(done.done, what)
        done.result()

    @staticmethod
    def wait(condition: Callable[[], Any], what: str, timeout: float = 90.0) -> None:
        """Wait until the condition is true. Fails with `what` in the message."""
        end = time.monotonic() + timeout
        while True:
            began = time.thread_time()
            if condition():
                return
            assert time.monotonic() < end, f"waited {timeout} s for {what}"
            # A condition that reads a map must leave processor time to the process that it waits for.
            time.sleep(max(0.01, 5 * (time.thread_time() - began)))

    def close(self) -> None:
        """Kill the processes, end the spinning thread, close the nodes under test as programs do, and then the rest."""
        for process in self._processes:
            process.kill()
            process.wait()
        self._ended.set()
        self._executor.wake()
        self._thread.join()
        try:
            for node in self._closing:
                node.close()
        finally:
            self._executor.shutdown()
            end_ros(*self._closing, self.node)
