# SPDX-License-Identifier: Apache-2.0
"""The life of a process: signals, spinning, which thread comes first. One or several SIGINT or SIGTERM end it cleanly,
and so does a terminal that is closed.

rclpy's own handlers give up at the second SIGINT, which `ros2 launch` sends, and with them a map that is being saved.
"""

from __future__ import annotations

import faulthandler
import gc
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.interrupt import hang_up_as_terminated
from dpm2_ros.share import share_directory
from dpm2_ros.shared_memory import free_shared_memory

_SWITCH = 5e-4
"""s until a thread must hand Python's lock on. The odometry asks for it tens of times per frame; with the usual 5 ms a
network in the thread of the map keeps it waiting each time."""
_SLICE = 0.05  # s after `Stop.set` within which who waits goes on
_PROFILE, _NEW_NAME = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
_NICER = 10  # steps of niceness: a tenth of the fraction of the odometry where both want a processor


class Stop:
    """As `threading.Event`, for signal handlers.

    An event's `set` waits for ever in a handler that interrupts its `wait` or `set`; and any lock, also that of a
    queue, waits for its whole timeout when the signal comes right before it begins. Sleeping in slices has neither.
    """

    def __init__(self) -> None:
        self._is_set = False

    def is_set(self) -> bool:
        """Whether `set` was called."""
        return self._is_set

    def set(self) -> None:
        """From here on `is_set`, and no `wait` waits."""
        self._is_set = True

    def wait(self, timeout: float = math.inf) -> bool:
        """Until `set`, or for `timeout` s.

        Returns:
            Whether it is set.
        """
        end = time.monotonic() + timeout
        while not self._is_set and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, _SLICE))
        return self._is_set


STOP = Stop()
"""Set by the first signal."""


def catch_signals() -> None:
    """From here on SIGINT, SIGTERM and a terminal that is closed set `STOP` and nothing else."""
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: STOP.set())
    hang_up_as_terminated()


def ignore_signals() -> None:
    """From here on SIGINT and SIGTERM do nothing, for a process that ends: Python keeps this, and no other handler."""
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, signal.SIG_IGN)


def use_dds_profile() -> None:
    """From here on Fast DDS has the shared memory that clouds need, unless the user has configured it.

    It reads the variable when the process makes its first participant; that of Jazzy has only the older name.
    """
    configured = os.environ.get("FASTDDS_BUILTIN_TRANSPORTS") or Path("DEFAULT_FASTRTPS_PROFILES.xml").is_file()
    if os.environ.get(_PROFILE) or (configured and not os.environ.get(_NEW_NAME)):
        return
    try:
        os.environ[_PROFILE] = os.environ.get(_NEW_NAME) or str(share_directory() / "config" / "fastdds.xml")
    except Dpm2Error as error:
        print(f"large messages may be lost, without the DDS profile: {error}", file=sys.stderr)


def ros_context(arguments: Sequence[str], domain: int | None = None) -> None:
    """rclpy.init with the DDS profile and without its signal handlers, and without what killed processes have left.

    Args:
        domain: None takes that of the environment.

    Raises:
        UsageError: `--ros-args` that ROS does not understand, or it cannot start, as without a folder for its logs.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    use_dds_profile()
    free_shared_memory()
    try:
        rclpy.init(args=list(arguments), domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy raises RCLError, UnknownROSArgsError and RuntimeError by the kind of mistake
        what = "unknown ROS arguments" if type(error).__name__ == "UnknownROSArgsError" else "ROS does not start"
        text = str(error).splitlines()[0]
        hint = "; set ROS_LOG_DIR or HOME" if re.search(r"log(ging)? directory|\.log for writing", text) else ""
        raise UsageError(f"{what}: {text}{hint}") from None


def spin_node(load: Callable[[], Callable[[], Any]], arguments: Sequence[str]) -> int:
    """Make a node, spin it until a signal comes, close it; nothing of that if one came before.

    Args:
        load: imports the node, which takes seconds: wrong arguments are answered before. What it returns makes a
            `GuardedNode` with `close()`, which saves what must be saved and may raise Dpm2Error.
        arguments: those of the process, without its name.
    """
    if STOP.is_set():
        return 0
    ros_context(arguments)
    nodes = list[Any]()
    try:
        make = load()
        gc.freeze()  # each search for garbage through what was imported would take longer than a frame
        if not STOP.is_set():  # else no map is opened, no network loaded
            sys.setswitchinterval(_SWITCH)
            nodes.append(make())
            _spin(nodes[0])
    finally:
        end_ros(*nodes)
    return 0


def _spin(node: Any) -> None:
    """Until a signal comes; then close it."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not STOP.is_set():
            try:
                executor.spin_once(timeout_sec=0.1)
            except Exception as error:  # of a service, or of rclpy itself; callbacks are guarded
                node.fail("executor", error)
                STOP.wait(0.01)  # what fails each time leaves the rest some time
    finally:
        try:
            node.close()
        finally:
            executor.shutdown()


def end_ros(*nodes: Any, within: float = 20.0) -> None:
    """Destroy nodes and shut ROS down.

    Before Fast DDS deletes a participant it waits until none of its listeners runs. Built for a glibc before 2.30, as
    in the wheels, that wait (`DomainParticipantImpl::set_listener`) computes a time that has overflowed, spins, and
    keeps the lock without which a listener cannot end: of 80 times that five nodes were stopped together one left a
    process that never ended. Here the listeners come first, so that there is none to wait for.

    Args:
        within: s, after which the process ends with exit code 1 and says where it was. It takes 0.02 s, and 2 s on a
            busy machine.
    """
    import rclpy

    def end() -> None:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()

    faulthandler.dump_traceback_later(within, exit=True, file=2)  # standard error, whatever sys.stderr is
    try:
        with _on_one_processor(), ThreadPoolExecutor(1, initializer=lower_priority) as thread:
            thread.submit(end).result()
    finally:
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def _on_one_processor() -> Iterator[None]:
    """All threads of this process: what wakes up there interrupts what has a lower priority."""
    if sys.platform != "linux":
        yield
        return
    allowed = os.sched_getaffinity(0)
    try:
        _allow({min(allowed)})
        yield
    finally:
        _allow(allowed)


def _allow(processors: set[int]) -> None:
    """Let all threads of this process run on these."""
    for thread in os.listdir("/proc/self/task"):
        with suppress(OSError):  # it has ended
            os.sched_setaffinity(int(thread), processors)


def lower_priority() -> None:
    """Of this thread, and of those that it starts: a map may wait, the next scan may not."""
    if sys.platform == "linux":  # elsewhere a thread has no number of its own for this
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + _NICER)
