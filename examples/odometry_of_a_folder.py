# SPDX-License-Identifier: Apache-2.0
"""Odometry of a recording: python examples/odometry_of_a_folder.py RECORDING POSES.txt

The poses are those of the LiDAR. `dpm2 eval --gt RECORDING --est POSES.txt` needs `--calib CALIB.txt` if the ground
truth is that of KITTI's left camera.
"""

import sys

import numpy as np

from dpm2_core import SlamSettings, make_odometry, open_source, write_kitti

source = open_source(sys.argv[1])
odometry = make_odometry(SlamSettings())
results = [odometry.process(frame) for frame in source.frames()]
write_kitti(sys.argv[2], np.array([result.T_odom_lidar for result in results]))
print(f"{len(results)} frames, {sum(not result.registration.ok for result in results)} of them not registered")
