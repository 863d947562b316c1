# SPDX-License-Identifier: Apache-2.0
"""Differentiable LiDAR odometry as a training signal: `SlamLoss()(pred_clouds, target_clouds, weights)`.

After "Differentiable SLAM Helps Deep Learning-based LiDAR Perception Tasks" (BMVC 2023). Pure torch, CPU and GPU.
"""

from dpm2_core.diffslam.schedule import ScheduleSettings, is_due, total_loss
from dpm2_core.diffslam.trajectory_loss import SlamLoss, SlamLossSettings, odometry, trajectory_loss
from dpm2_core.diffslam.windows import ContiguousWindows

__all__ = [
    "ContiguousWindows",
    "ScheduleSettings",
    "SlamLoss",
    "SlamLossSettings",
    "is_due",
    "odometry",
    "total_loss",
    "trajectory_loss",
]
