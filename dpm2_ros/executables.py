# SPDX-License-Identifier: Apache-2.0
"""Entry points. Signals are caught before the slow imports, so that a process stopped while starting ends cleanly."""

from __future__ import annotations

import sys

from dpm2_ros.runtime import catch_signals, exit_code, spin_node


def slam_node() -> int:
    """`ros2 run dpm2_ros slam_node`."""
    catch_signals()

    def work() -> int:
        from dpm2_ros.slam_node import SlamNode

        return spin_node(SlamNode, sys.argv[1:])

    return exit_code(work)


def mapper_node() -> int:
    """`ros2 run dpm2_ros mapper_node`."""
    catch_signals()

    def work() -> int:
        from dpm2_ros.mapper_node import MapperNode

        return spin_node(MapperNode, sys.argv[1:])

    return exit_code(work)


def bag_player() -> int:
    """`ros2 run dpm2_ros bag_player`."""
    catch_signals()

    def work() -> int:
        from dpm2_ros.bag_player import main

        return main(sys.argv[1:])

    return exit_code(work)
