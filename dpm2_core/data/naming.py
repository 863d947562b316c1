# SPDX-License-Identifier: Apache-2.0
"""Topics and frames of a KITTI bag, named as the kitti2bag tool made them usual, and of other drives' bags."""

from __future__ import annotations

from dataclasses import dataclass

IMU = "/imu"
FIX = "/fix"
TF, TF_STATIC = "/tf", "/tf_static"
VERTICAL_ANGLE_CORRECTION = "/kitti/vertical_angle_correction_deg"
"""std_msgs/Float64, latched: degrees to add to the elevation of each point, which the recording itself lacks."""

MAP, BASE, IMU_LINK, GNSS_LINK = "map", "base_link", "imu_link", "gnss_link"
GRAY_CAMERA = "camera_gray_left"
"""KITTI's camera 0, which poses and Tr refer to."""


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


KITTI = Names(
    "/kitti/velo/pointcloud", "/kitti/camera_color_left", "/kitti/ground_truth", "velo_link", "camera_color_left"
)
OTHER = Names("/points", "/camera", "/ground_truth", "lidar", "camera")
"""Not below /kitti/, where points need a correction and images are rectified."""
POINTS, IMAGE = KITTI.points, f"{KITTI.camera}/image_raw"
TRUTHS = tuple(f"{names.truth}/{kind}" for names in (KITTI, OTHER) for kind in ("odom", "path"))
"""Where ground truth is looked for."""


def frame_name(frame: str) -> str:
    """The name of a frame as it is compared: those of ROS 1 had a leading slash."""
    return frame.lstrip("/")
