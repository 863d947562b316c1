# SPDX-License-Identifier: Apache-2.0
"""The life of a process: signals, spinning, priorities of threads. One or several SIGINT or SIGTERM end it cleanly, and
so does a closed terminal.

With rclpy's own handlers, the second SIGINT, which `ros2 launch` sends, would end the process while it saves a map.
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

_SWITCH_INTERVAL = 5e-4
"""s after which a thread must release Python's global lock. The odometry acquires it tens of times per frame; with the
default of 5 ms, a network in the thread of the map delays the odometry each time."""
_WAIT_SLICE = 0.05  # s after `Stop.set` within which `Stop.wait` returns
_PROFILE_VARIABLE, _NEW_PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
_NICENESS_STEPS = 10  # steps of niceness: a tenth of the odometry's share if both compete for a processor


class Stop:
    """As `threading.Event`, for signal handlers.

    An event's `set` blocks for ever in a handler that interrupts its `wait` or `set`. And any lock, also that of a
    queue, waits for its whole timeout if the signal arrives right before the wait begins. Sleeping in slices avoids
    both.
    """

    def __init__(self) -> None:
        self._is_set = False

    def is_set(self) -> bool:
        """Whether `set` was called."""
        return self._is_set

    def set(self) -> None:
        """From now on `is_set` is true, and `wait` returns."""
        self._is_set = True

    def wait(self, timeout: float = math.inf) -> bool:
        """Wait until `set`, or for `timeout` s.

        Returns:
            Whether it is set.
        """
        end = time.monotonic() + timeout
        while not self._is_set and (remaining := end - time.monotonic()) > 0:
            time.sleep(min(remaining, _WAIT_SLICE))
        return self._is_set


STOP = Stop()
"""Set by the first signal."""


def catch_signals() -> None:
    """From here on SIGINT, SIGTERM and a closed terminal set `STOP` and do nothing else."""
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: STOP.set())
    hang_up_as_terminated()


def ignore_signals() -> None:
    """From here on SIGINT and SIGTERM do nothing, for a process that ends: Python then resets all other handlers."""
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, signal.SIG_IGN)


def use_dds_profile() -> None:
    """From here on Fast DDS uses the shared memory that clouds need, unless the user has configured it.

    It reads the variable when the process creates its first participant; that of Jazzy reads only the older name.
    """
    configured = os.environ.get("FASTDDS_BUILTIN_TRANSPORTS") or Path("DEFAULT_FASTRTPS_PROFILES.xml").is_file()
    if os.environ.get(_PROFILE_VARIABLE) or (configured and not os.environ.get(_NEW_PROFILE_VARIABLE)):
        return
    try:
        os.environ[_PROFILE_VARIABLE] = os.environ.get(_NEW_PROFILE_VARIABLE) or str(
            share_directory() / "config" / "fastdds.xml"
        )
    except Dpm2Error as error:
        print(f"large messages may be lost, without the DDS profile: {error}", file=sys.stderr)


def ros_context(arguments: Sequence[str], domain: int | None = None) -> None:
    """Call rclpy.init, with the DDS profile and without its signal handlers; free the memory of killed processes.

    Args:
        domain: None takes that of the environment.

    Raises:
        UsageError: `--ros-args` is invalid, or ROS cannot start, as without a folder for its logs.
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
    """Create a node, spin it until a signal arrives, close it; nothing of that if a signal arrived before.

    Args:
        load: imports the node, which takes seconds: invalid arguments are reported before. The function that it returns
            creates a `GuardedNode` with `close()`, which saves what must be saved and may raise Dpm2Error.
        arguments: those of the process, without its name.
    """
    if STOP.is_set():
        return 0
    ros_context(arguments)
    nodes = list[Any]()
    try:
        make = load()
        gc.freeze()  # a garbage collection of all imported objects would take longer than a frame
        if not STOP.is_set():  # else no map is opened, no network loaded
            sys.setswitchinterval(_SWITCH_INTERVAL)
            nodes.append(make())
            _spin(nodes[0])
    finally:
        end_ros(*nodes)
    return 0


def _spin(node: Any) -> None:
    """Spin a node until a signal arrives, then close it."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not STOP.is_set():
            try:
                executor.spin_once(timeout_sec=0.1)
            except Exception as error:  # of a service, or of rclpy itself; callbacks are guarded
                node.fail("executor", error)
                STOP.wait(0.01)  # if it fails each time, other threads can still work
    finally:
        try:
            node.close()
        finally:
            executor.shutdown()


def end_ros(*nodes: Any, within: float = 20.0) -> None:
    """Destroy nodes and shut ROS down.

    Before Fast DDS deletes a participant, it waits until none of its listeners runs. Built for a glibc before 2.30, as
    in the wheels, that wait (`DomainParticipantImpl::set_listener`) computes a time that overflows. It spins, and holds
    the lock that a listener needs to end: when five nodes were stopped together 80 times, one process never ended. Here
    the listeners have priority, so that there is none to wait for.

    Args:
        within: s after which the process ends with exit code 1 and prints where it was. Usually it takes 0.02 s, and
            2 s on a busy machine.
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
    """Run all threads of this process on one processor: a thread that wakes up interrupts one of lower priority."""
    if sys.platform != "linux":
        yield
        return
    allowed = os.sched_getaffinity(0)
    try:
        _set_affinity({min(allowed)})
        yield
    finally:
        _set_affinity(allowed)


def _set_affinity(processors: set[int]) -> None:
    """Let all threads of this process run on these."""
    for thread in os.listdir("/proc/self/task"):
        with suppress(OSError):  # it has ended
            os.sched_setaffinity(int(thread), processors)


def lower_priority() -> None:
    """Lower the priority of this thread and of those that it starts: the map may wait, the next scan may not."""
    if sys.platform == "linux":  # elsewhere a single thread has no priority that can be set like this
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + _NICENESS_STEPS)
