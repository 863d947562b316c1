# SPDX-License-Identifier: Apache-2.0
"""dpm2: LiDAR-visual SLAM with neural descriptors. No ROS import anywhere in this package."""

__version__ = "0.1.0"
