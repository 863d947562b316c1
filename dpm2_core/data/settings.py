# SPDX-License-Identifier: Apache-2.0
"""How recordings and sensor messages are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from scipy.spatial.transform import Rotation

from dpm2_core.config import Settings, load_settings
from dpm2_core.data.point_times import TimeUnit
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

# x, y, z in m, then a quaternion x, y, z, w: the order of tf2_ros' static_transform_publisher.
Place = tuple[float, float, float, float, float, float, float]


def _unit_quaternion(numbers: tuple[float, ...]) -> tuple[float, ...]:
    if abs(sum(q * q for q in numbers[-4:]) - 1) > 0.01:
        raise ValueError("qx, qy, qz, qw are no unit quaternion")
    return numbers


class InputSettings(Settings):
    """How recordings and sensor messages are read."""

    sequence: str = ""
    """Sequence of a root folder: 04 of KITTI odometry, 0009 of KITTI raw or KITTI-360, Town01 of KITTI-CARLA; empty
    takes the only one."""

    dataset: str = ""
    """Loader of KISS-ICP's that reads the recording (extra datasets): mulran, ncd, nclt, helipr, boreas, apollo, ...;
    empty recognizes the recording by itself."""

    kitti_poses: Literal["auto", "kitti", "semantic_kitti"] = "auto"
    """Ground truth of KITTI odometry: poses/NN.txt (kitti), poses.txt in the sequence's folder, which SemanticKITTI
    publishes (semantic_kitti), or the latter where it is there, else the former (auto)."""

    points_topic: str = ""
    """PointCloud2 or Livox CustomMsg topic of a bag; empty takes /kitti/velo/pointcloud, else the only one. Of a
    recording of several Ousters: the serial number of one."""

    second_points_topic: str = ""
    """Topic of a second LiDAR, whose place /tf_static knows: each cloud of `points_topic` is joined by the nearest of
    this one within `image_tolerance`; empty: none."""

    images: bool = True
    """Use the camera where there is one."""

    image_topic: str = ""
    """Image or CompressedImage topic of a bag; empty takes /kitti/camera_color_left/image_raw, else the only one (those
    of depth do not count, nor what is compressed beside the same, raw)."""

    camera_info_topic: str = ""
    """CameraInfo topic of that image; empty takes the camera_info beside it."""

    T_lidar_cam: Annotated[Place, AfterValidator(_unit_quaternion)] | None = None
    """Pose of the camera's optical frame in the LiDAR frame, [x, y, z (m), qx, qy, qz, qw]; null asks /tf_static."""

    second_image_topic: str = ""
    """Image or CompressedImage topic of a second camera, with a camera_info beside it, whose place /tf_static knows;
    empty: none."""

    image_tolerance: Annotated[float, Field(gt=0, le=10)] = 0.05
    """Largest difference of time between a cloud and what goes with it: images, the cloud of a second LiDAR, s."""

    image_time_offset: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Added to the stamps of images before they are compared with those of clouds, s."""

    imu: bool = True
    """Use the IMU where there is one."""

    imu_topic: str = ""
    """Imu topic; empty takes /imu (as a ROS name `imu`, to remap), else the only one of a bag."""

    q_lidar_imu: Annotated[tuple[float, float, float, float], AfterValidator(_unit_quaternion)] | None = None
    """Rotation of the IMU's frame in the LiDAR's, [qx, qy, qz, qw]; null asks /tf_static."""

    gnss_topic: str = ""
    """NavSatFix topic, whose fixes hold the map in its place on Earth; /tf_static is asked for the antenna's; empty:
    none."""

    period: Annotated[float, Field(gt=0, le=3600)] = 0.1
    """Time between the scans of a folder in which nothing says when they were taken, s."""

    time_field: str | None = None
    """PointCloud2 field with the time of each point; null looks for a usual name (t, time_offset_ns, ...), "": none."""

    time_unit: TimeUnit = "auto"
    """Unit of that field; auto takes that of its name (_ns), else the one in which a scan lasts 2 ms to 2 s."""

    intensity_max: Annotated[float, Field(gt=0)] | None = None
    """Intensity that becomes 1; null takes 1, 255 or 65535 by the largest value of each cloud."""

    vertical_angle_correction_deg: Annotated[float, Field(ge=-5, le=5)] | Literal["auto"] = "auto"
    """Added to the elevation of each point, degrees. auto: what the recording says (dpm2_sim.json of a folder, topic
    /kitti/vertical_angle_correction_deg of a bag), else KITTI's 0.205 for topics under /kitti/ and for its folders,
    unless their scans show another LiDAR, else 0."""

    ground_truth_topic: str = ""
    """Odometry or Path topic with true poses; empty takes odom, else path, of /kitti/ground_truth, else of
    /ground_truth."""

    def extrinsic(self) -> Array | None:
        """T_lidar_cam as (4, 4); None if it is not set here."""
        place = self.T_lidar_cam
        return None if place is None else se3.make(Rotation.from_quat(place[3:]).as_matrix(), place[:3])

    def steady_stamps(self, numbers: NDArray[np.integer], why: str, notes: list[str]) -> NDArray[np.int64]:
        """(N,) ns of scans by their numbers (N,), since nothing says when they were taken; a note tells why."""
        notes.append(f"{why}: scans are taken to be {self.period:g} s apart (input.period)")
        return np.round(numbers * self.period * 1e9).astype(np.int64)

    def angle_correction(self, known: float) -> float:
        """Degrees to add to the elevation of each point: what is set here, else what is `known` of the recording."""
        requested = self.vertical_angle_correction_deg
        return known if requested == "auto" else requested

    def imu_rotation(self) -> Array | None:
        """R_lidar_imu (3, 3); None if it is not set here."""
        return None if self.q_lidar_imu is None else np.asarray(Rotation.from_quat(self.q_lidar_imu).as_matrix())


class _OfInput(Settings):
    input: InputSettings = InputSettings()


def input_settings(overrides: Sequence[str]) -> InputSettings:
    """How a recording is read, of a command that has no other settings: named as in all others.

    Raises:
        UsageError: a key or value is not allowed.
    """
    return load_settings(_OfInput, None, overrides).input
