# SPDX-License-Identifier: Apache-2.0
"""Names of topics and frames: of KITTI bags, as the kitti2bag tool established them, and of other drives' bags."""

from __future__ import annotations

from dataclasses import dataclass

IMU = "/imu"
FIX = "/fix"
TF, TF_STATIC = "/tf", "/tf_static"
VERTICAL_ANGLE_CORRECTION = "/kitti/vertical_angle_correction_deg"
"""std_msgs/Float64, latched: degrees to add to the elevation of each point; the recorded points lack it."""

MAP, BASE, IMU_LINK, GNSS_LINK = "map", "base_link", "imu_link", "gnss_link"
GRAY_CAMERA = "camera_gray_left"
"""KITTI's camera 0, which poses and Tr refer to."""


@dataclass(frozen=True)
class Names:
    """Names of the sensors in a drive's bag; a second camera has the name of the first with the suffix _2.

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
"""Not under /kitti/, where points need a correction and images are rectified."""
POINTS, IMAGE = KITTI.points, f"{KITTI.camera}/image_raw"
TRUTHS = tuple(f"{names.truth}/{kind}" for names in (KITTI, OTHER) for kind in ("odom", "path"))
"""Default topics of ground truth."""


def frame_name(frame: str) -> str:
    """A frame's name in the form used for comparison: names in ROS 1 had a leading slash."""
    return frame.lstrip("/")
