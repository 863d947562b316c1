# SPDX-License-Identifier: Apache-2.0
"""dpm2: LiDAR-visual SLAM with neural descriptors. No ROS import anywhere in this package."""

import os

__version__ = "0.1.0"

# OpenMP reads this once, when the first library that uses it is loaded. By default its threads spin while they wait for
# each other: on processors shared with other programs that costs 3 times the processor time and half the speed.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "20000")  # some 50 us: a sleep between two small layers takes longer than both
