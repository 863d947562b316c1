# SPDX-License-Identifier: Apache-2.0
"""Entry points: console scripts, `ros2 run dpm2_ros NAME`, and `python -m dpm2_ros.executables NAME`.

Signals are caught before the slow imports, so that a process also ends cleanly if it is stopped during its start.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from dpm2_core.errors import UsageError, exit_code
from dpm2_core.imports import importing
from dpm2_core.openmp import wait_passively
from dpm2_ros.runtime import catch_signals, ignore_signals, spin_node

_MANAGED = "--lifecycle"


def slam_node(arguments: Sequence[str] | None = None) -> int:
    """Odometry and, by default, the map; with `--lifecycle` a node that waits to be configured and activated."""
    return _run(partial(_spin, "slam_node", "SlamNode"), arguments)


def mapper_node(arguments: Sequence[str] | None = None) -> int:
    """The mapper in a process of its own; `--lifecycle` as for slam_node."""
    return _run(partial(_spin, "mapper_node", "MapperNode"), arguments)


def bag_player(arguments: Sequence[str] | None = None) -> int:
    """Plays a recording."""

    def work(arguments: Sequence[str]) -> int:
        with importing():
            from dpm2_ros.bag_player import main

        return main(arguments)

    return _run(work, arguments)


def _spin(name: str, class_name: str, arguments: Sequence[str]) -> int:
    """A node of the class `class_name`, in the module of its name."""
    if "--help" in arguments:
        print(f"usage: {name} [{_MANAGED}] [--ros-args -p NAME:=VALUE ...]; docs/parameters.md lists the parameters")
        return 0
    ros_arguments = [text for text in arguments if text != _MANAGED]

    def load() -> Callable[[], Any]:
        from rclpy.utilities import remove_ros_args

        if unknown := remove_ros_args(["", *ros_arguments])[1:]:
            raise UsageError(f"unknown argument {unknown[0]}; those of ROS, such as -p, come after --ros-args")
        with importing():
            node = getattr(import_module(f"dpm2_ros.{name}"), class_name)
        return partial(node, len(ros_arguments) < len(arguments))

    return spin_node(load, ros_arguments)


def _run(work: Callable[[Sequence[str]], int], arguments: Sequence[str] | None) -> int:
    catch_signals()
    wait_passively()

    def with_ros() -> int:
        try:
            return work(sys.argv[1:] if arguments is None else arguments)
        except ModuleNotFoundError:
            if find_spec("rclpy") is not None:
                raise
            raise UsageError("no ROS 2 here: install it and source its setup.bash, see docs/ros2.md") from None

    try:
        return exit_code(with_ros)
    finally:
        ignore_signals()
        gc.freeze()  # else the garbage collection at Python's end takes half a second


if __name__ == "__main__":
    executables = {"slam_node": slam_node, "mapper_node": mapper_node, "bag_player": bag_player}
    if len(sys.argv) < 2 or sys.argv[1] not in executables:
        sys.exit(f"usage: python -m dpm2_ros.executables {{{','.join(executables)}}} ...")
    sys.exit(executables[sys.argv[1]](sys.argv[2:]))
