# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 side: thin nodes around `dpm2_core`. Threads, queues, sockets and clocks live here and nowhere else."""
