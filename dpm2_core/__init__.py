# SPDX-License-Identifier: Apache-2.0
"""dpm2: LiDAR-visual SLAM with neural descriptors. No ROS import anywhere in this package."""

from dpm2_core._version import __version__ as __version__
