# SPDX-License-Identifier: Apache-2.0
"""Topics and frames of a KITTI bag, named as the kitti2bag tool made them usual, and of other drives' bags."""

from __future__ import annotations

from dataclasses import dataclass

POINTS = "/kitti/velo/pointcloud"
IMAGE = "/kitti/camera_color_left/image_raw"
CAMERA_INFO = "/kitti/camera_color_left/camera_info"
IMU = "/imu"
FIX = "/fix"
TF_STATIC = "/tf_static"
ODOMETRY = "/kitti/ground_truth/odom"
PATH = "/kitti/ground_truth/path"
VERTICAL_ANGLE_CORRECTION = "/kitti/vertical_angle_correction_deg"
"""std_msgs/Float64, latched: degrees to add to the elevation of each point, which the recording itself lacks."""


MAP, BASE, LIDAR, IMU_LINK, GNSS_LINK = "map", "base_link", "velo_link", "imu_link", "gnss_link"
GRAY_CAMERA = "camera_gray_left"
"""KITTI's camera 0, which poses and Tr refer to."""
COLOR_CAMERA = "camera_color_left"


@dataclass(frozen=True)
class Names:
    """What the bag of a drive calls its sensors: a second camera has the name of the first with _2 behind it.

    Attributes:
        points: topic. camera: namespace of the images and their calibration. truth: namespace of ground truth.
        lidar, optical: frames of the LiDAR and of the camera.
    """

    points: str
    camera: str
    truth: str
    lidar: str
    optical: str


KITTI = Names(POINTS, "/kitti/camera_color_left", "/kitti/ground_truth", LIDAR, COLOR_CAMERA)
OTHER = Names("/points", "/camera", "/ground_truth", "lidar", "camera")
"""Not below /kitti/, where points need a correction and images are rectified."""
TRUTHS = tuple(f"{names.truth}/{kind}" for names in (KITTI, OTHER) for kind in ("odom", "path"))
"""Where ground truth is looked for."""
