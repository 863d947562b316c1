# SPDX-License-Identifier: Apache-2.0
"""Settings for reading recordings and sensor messages."""

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
    """Settings for reading recordings and sensor messages."""

    sequence: str = ""
    """Sequence in a root folder: 04 of KITTI odometry, 0009 of KITTI raw or KITTI-360, Town01 of KITTI-CARLA; empty
    takes the only one."""

    dataset: str = ""
    """KISS-ICP loader that reads the recording (extra datasets): mulran, ncd, nclt, helipr, boreas, apollo, ...; empty
    detects the type of the recording automatically."""

    kitti_poses: Literal["auto", "kitti", "semantic_kitti"] = "auto"
    """Ground truth of KITTI odometry: poses/NN.txt (kitti), poses.txt in the sequence's folder as published by
    SemanticKITTI (semantic_kitti), or poses.txt if it exists, else poses/NN.txt (auto)."""

    points_topic: str = ""
    """PointCloud2 or Livox CustomMsg topic of a bag; empty takes /kitti/velo/pointcloud, else the only one. For a
    recording of several Ouster LiDARs: the serial number of one."""

    second_points_topic: str = ""
    """Topic of a second LiDAR, whose pose is on /tf_static. The nearest of its clouds within `image_tolerance` is
    merged into each cloud of `points_topic`; if these are parts of a sweep, into the nearest. Empty: none."""

    images: bool = True
    """Use the camera if there is one."""

    image_topic: str = ""
    """Image or CompressedImage topic of a bag; empty takes /kitti/camera_color_left/image_raw, else the only one. Depth
    images do not count, nor does a compressed topic if the same images are also recorded raw."""

    camera_info_topic: str = ""
    """CameraInfo topic of that image; empty takes camera_info in the same namespace."""

    T_lidar_cam: Annotated[Place, AfterValidator(_unit_quaternion)] | None = None
    """Pose of the camera's optical frame in the LiDAR frame, [x, y, z (m), qx, qy, qz, qw]; null reads /tf_static."""

    second_image_topic: str = ""
    """Image or CompressedImage topic of a second camera, with camera_info in the same namespace and its pose on
    /tf_static; empty: none."""

    image_tolerance: Annotated[float, Field(gt=0, le=10)] = 0.05
    """Largest time difference between a cloud and the images, or the cloud of a second LiDAR, associated with it, s."""

    image_time_offset: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Added to the stamps of images before they are compared with the stamps of clouds, s."""

    imu: bool = True
    """Use the IMU if there is one."""

    imu_topic: str = ""
    """Imu topic; empty takes /imu (as a ROS name `imu`, to remap), else the only one of a bag."""

    q_lidar_imu: Annotated[tuple[float, float, float, float], AfterValidator(_unit_quaternion)] | None = None
    """Rotation of the IMU frame in the LiDAR frame, [qx, qy, qz, qw]; null reads /tf_static."""

    gnss_topic: str = ""
    """NavSatFix topic, whose fixes georeference the map; the antenna's position is read from /tf_static; empty:
    none."""

    period: Annotated[float, Field(gt=0, le=3600)] = 0.1
    """Time between the scans of a folder that contains no time stamps, s."""

    time_field: str | None = None
    """PointCloud2 field with the time of each point; null looks for a usual name (t, time_offset_ns, ...), "": none."""

    time_unit: TimeUnit = "auto"
    """Unit of that field; auto takes the unit in its name (_ns), else the one in which a scan lasts 2 ms to 2 s."""

    intensity_max: Annotated[float, Field(gt=0)] | None = None
    """Intensity that is scaled to 1; null takes 1, 255 or 65535, by the largest value of each cloud."""

    vertical_angle_correction_deg: Annotated[float, Field(ge=-5, le=5)] | Literal["auto"] = "auto"
    """Added to the elevation of each point, degrees. auto takes the recording's value (dpm2_sim.json of a folder, topic
    /kitti/vertical_angle_correction_deg of a bag), else KITTI's 0.205 for topics under /kitti/ and for KITTI folders
    unless their scans show another LiDAR, else 0."""

    ground_truth_topic: str = ""
    """Odometry or Path topic with true poses; empty takes odom, else path, under /kitti/ground_truth, else under
    /ground_truth."""

    def extrinsic(self) -> Array | None:
        """T_lidar_cam as (4, 4); None if it is not set."""
        pose = self.T_lidar_cam
        return None if pose is None else se3.make(Rotation.from_quat(pose[3:]).as_matrix(), pose[:3])

    def steady_stamps(self, numbers: NDArray[np.integer], why: str, notes: list[str]) -> NDArray[np.int64]:
        """(N,) ns of scans without time stamps, from their numbers (N,); adds a note that begins with `why`."""
        notes.append(f"{why}: scans are assumed to be {self.period:g} s apart (input.period)")
        return np.round(numbers * self.period * 1e9).astype(np.int64)

    def angle_correction(self, known: float) -> float:
        """Degrees to add to the elevation of each point: the value set here, else the recording's value `known`."""
        requested = self.vertical_angle_correction_deg
        return known if requested == "auto" else requested

    def imu_rotation(self) -> Array | None:
        """R_lidar_imu (3, 3); None if it is not set."""
        return None if self.q_lidar_imu is None else np.asarray(Rotation.from_quat(self.q_lidar_imu).as_matrix())


class _InputOnly(Settings):
    input: InputSettings = InputSettings()


def input_settings(overrides: Sequence[str]) -> InputSettings:
    """Input settings for a command that has no other settings; the keys are the same as for all other commands.

    Raises:
        UsageError: a key or value is not allowed.
    """
    return load_settings(_InputOnly, None, overrides).input
