# SPDX-License-Identifier: Apache-2.0
"""Message types read from a bag. In a module of its own, so that a player can import them without the readers."""

from __future__ import annotations

from dpm2_core.data.livox import LIVOX

CLOUD = "sensor_msgs/msg/PointCloud2"
CLOUDS = (CLOUD, *LIVOX)
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
PATH = "nav_msgs/msg/Path"
TRUTHS = ("nav_msgs/msg/Odometry", PATH)
