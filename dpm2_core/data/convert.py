# SPDX-License-Identifier: Apache-2.0
"""A KITTI odometry sequence as a rosbag2 MCAP recording that `ros2 bag play`, Foxglove and dpm2 read alike."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from dpm2_core.data import topics
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.messages import cloud_fields, point_columns
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import Span
from dpm2_core.errors import UsageError
from dpm2_core.files import not_written
from dpm2_core.frame import Array, Camera, Fix, Frame
from dpm2_core.geometry import se3

EPOCH_NS = 1_316_995_200_000_000_000
"""Added to times.txt: 26 September 2011, KITTI's first day. ROS takes a stamp near 0 for none."""

# The odometry set has no such calibration: kitti2bag's base_link, the middle of the wheelbase at ground level.
_T_BASE_LIDAR = se3.make(np.eye(3), [-0.59, 0.0, 1.73])

_TYPES = get_typestore(Stores.ROS2_JAZZY).types


def convert_kitti(
    source: KittiSource,
    out: Path,
    frames: Span = (0, None),
    zstd: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[str]:
    """Write frames of a sequence to the new folder `out`; it appears whole or not at all.

    Points are written as they are; the vertical angle correction that they need is recorded beside them.

    Args:
        source: with its images, as rgb8.
        frames: positions of the first and of the one to stop before.
        zstd: compress the chunks of the file.
        overwrite: replace a bag at `out`.
        progress: called with frames written and frames in all.

    Returns:
        What the user should know, in words.

    Raises:
        UsageError: no such frames, or `out` is taken.
        Dpm2Error: it could not be written (disk full); nothing is left behind.
    """
    start, end = frames
    positions = range(len(source))[start:end]
    if not positions:
        raise UsageError(f"{source.path}: no frames {start}:{'' if end is None else end}; it has {len(source)}")
    with _new_folder(out, overwrite) as folder:
        writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        if zstd:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            bag = _KittiBag(writer, source, positions)
            for done, frame in enumerate(prefetch(bag.source.frames(positions.start, positions.stop)), 1):
                bag.write(frame)
                progress(done, len(positions))
    return source.notes


class _KittiBag:
    """The topics of one recording; the constructor writes those that come once."""

    def __init__(self, writer: Writer, source: KittiSource, positions: range) -> None:
        self._writer = writer
        self.source = copy(source)
        self.source.vertical_angle_correction_deg = 0.0  # recorded here, applied by who reads
        self._connections: dict[str, Any] = {}
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        first = EPOCH_NS + int(source.stamps[positions.start])
        correction = _TYPES["std_msgs/msg/Float64"](data=source.vertical_angle_correction_deg)
        self._put(topics.VERTICAL_ANGLE_CORRECTION, first, correction, latched=True)
        transforms = [_transform(first, parent, child, T) for parent, child, T in _static_frames(source)]
        self._put(topics.TF_STATIC, first, _TYPES["tf2_msgs/msg/TFMessage"](transforms=transforms), latched=True)
        self._poses: dict[int, Array] = {}
        if source.poses is not None:
            rows = [(i, source.poses[i]) for i in positions if np.isfinite(source.poses[i]).all()]
            self._poses = {int(source.numbers[i]): T for i, T in rows}
            stamped = [_pose_stamped(EPOCH_NS + int(source.stamps[i]), T) for i, T in rows]
            path = _TYPES["nav_msgs/msg/Path"](header=_header(first, topics.MAP), poses=stamped)
            self._put(topics.PATH, first, path, latched=True)

    def write(self, frame: Frame) -> None:
        """IMU, fix and image first: who waits for the cloud then has them already."""
        stamp = EPOCH_NS + frame.stamp
        if frame.imu is not None:
            R = self.source.R_lidar_imu  # back along its own axes
            samples = zip(frame.imu.stamps.tolist(), frame.imu.rates @ R, frame.imu.forces @ R, strict=True)
            for time, rates, forces in samples:
                self._put(topics.IMU, EPOCH_NS + time, _imu(EPOCH_NS + time, rates, forces))
        if frame.fix is not None:
            time = EPOCH_NS + frame.fix.stamp
            self._put(topics.FIX, time, _fix(time, frame.fix))
        if frame.problem:
            self.source.notes.append(f"{frame.problem}: written as an empty cloud")
        for image in frame.images:
            self._put(topics.CAMERA_INFO, stamp, _camera_info(stamp, image.camera))
            self._put(topics.IMAGE, stamp, _image(stamp, image.pixels))
        if frame.index in self._poses:
            self._put(topics.ODOMETRY, stamp, _odometry(stamp, self._poses[frame.index]))
        fields = cloud_fields(point_columns(frame.points), _TYPES["sensor_msgs/msg/PointField"])
        cloud = _TYPES["sensor_msgs/msg/PointCloud2"](header=_header(stamp, topics.LIDAR), **fields)
        self._put(topics.POINTS, stamp, cloud)

    def _put(self, topic: str, stamp: int, msg: Any, latched: bool = False) -> None:
        kind = msg.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._typestore, offered_qos_profiles=[_qos(latched)]
            )
        self._writer.write(self._connections[topic], stamp, self._typestore.serialize_cdr(msg, kind))


@contextmanager
def _new_folder(out: Path, overwrite: bool) -> Iterator[Path]:
    """A folder to make and fill that takes the name `out` when the block ends well, and vanishes when it does not."""
    out = out.absolute()
    if out.suffix in (".mcap", ".db3", ".bag"):
        raise UsageError(f"{out}: a rosbag2 recording is a folder; leave out the {out.suffix}")
    if out.exists() and not (overwrite and (out / "metadata.yaml").is_file()):
        reason = "not a rosbag2 folder, so it is not overwritten" if overwrite else "use --overwrite to replace it"
        raise UsageError(f"{out}: exists already; {reason}")
    part = out.with_name(f".{out.name}.part")  # one name, so that the next try clears what a killed one left
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part / out.name  # the recording's file carries the folder's name
        for path in [*(part / out.name).iterdir(), part / out.name]:
            descriptor = os.open(path, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)
        if out.exists():
            out.rename(part / "replaced")
        (part / out.name).rename(out)
    except OSError as error:
        raise not_written(out, error) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _static_frames(source: KittiSource) -> list[tuple[str, str, Array]]:
    """(parent, child, T_parent_child)."""
    frames = [(topics.BASE, topics.LIDAR, _T_BASE_LIDAR)]
    if source.T_cam_lidar is not None:
        frames.append((topics.LIDAR, topics.GRAY_CAMERA, se3.inverse(source.T_cam_lidar)))
    if source.camera is not None:
        frames.append((topics.LIDAR, topics.COLOR_CAMERA, source.camera.T_lidar_cam))
    if source.imu is not None:
        frames.append((topics.LIDAR, topics.IMU_LINK, se3.make(source.R_lidar_imu, np.zeros(3))))
    if source.fixes:
        frames.append((topics.LIDAR, topics.GNSS_LINK, se3.make(np.eye(3), source.fixes[0].antenna)))
    return frames


def _qos(latched: bool) -> Qos:
    infinite = QosTime(9223372036, 854775807)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(QosHistory.KEEP_LAST, 1 if latched else 10, QosReliability.RELIABLE, durability, infinite, infinite,
               QosLiveliness.AUTOMATIC, infinite, False)  # fmt: skip


def _header(stamp: int, frame: str) -> Any:
    time = _TYPES["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return _TYPES["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _parts(T: Array) -> tuple[list[float], list[float]]:
    return T[:3, 3].tolist(), Rotation.from_matrix(T[:3, :3]).as_quat().tolist()


def _transform(stamp: int, parent: str, child: str, T: Array) -> Any:
    t, q = _parts(T)
    transform = _TYPES["geometry_msgs/msg/Transform"](
        translation=_TYPES["geometry_msgs/msg/Vector3"](*t), rotation=_TYPES["geometry_msgs/msg/Quaternion"](*q)
    )
    return _TYPES["geometry_msgs/msg/TransformStamped"](
        header=_header(stamp, parent), child_frame_id=child, transform=transform
    )


def _pose(T: Array) -> Any:
    t, q = _parts(T)
    return _TYPES["geometry_msgs/msg/Pose"](
        position=_TYPES["geometry_msgs/msg/Point"](*t), orientation=_TYPES["geometry_msgs/msg/Quaternion"](*q)
    )


def _pose_stamped(stamp: int, T: Array) -> Any:
    return _TYPES["geometry_msgs/msg/PoseStamped"](header=_header(stamp, topics.MAP), pose=_pose(T))


def _odometry(stamp: int, T: Array) -> Any:
    zero = _TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = _TYPES["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    return _TYPES["nav_msgs/msg/Odometry"](
        header=_header(stamp, topics.MAP),
        child_frame_id=topics.LIDAR,
        pose=_TYPES["geometry_msgs/msg/PoseWithCovariance"](pose=_pose(T), covariance=np.zeros(36)),
        twist=_TYPES["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def _imu(stamp: int, rates: Array, forces: Array) -> Any:
    vector, unknown = _TYPES["geometry_msgs/msg/Vector3"], np.zeros(9)  # covariances
    no_orientation = np.array([-1.0, *np.zeros(8)])  # as REP-145 has it
    return _TYPES["sensor_msgs/msg/Imu"](
        header=_header(stamp, topics.IMU_LINK), orientation=_TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        orientation_covariance=no_orientation, angular_velocity=vector(*rates.tolist()),
        angular_velocity_covariance=unknown, linear_acceleration=vector(*forces.tolist()),
        linear_acceleration_covariance=unknown,
    )  # fmt: skip


def _fix(stamp: int, fix: Fix) -> Any:
    latitude, longitude, altitude = fix.geodetic.tolist()
    return _TYPES["sensor_msgs/msg/NavSatFix"](
        header=_header(stamp, topics.GNSS_LINK), status=_TYPES["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=latitude, longitude=longitude, altitude=altitude, position_covariance=fix.covariance.ravel(),
        position_covariance_type=2,  # of the diagonal
    )  # fmt: skip


def _image(stamp: int, pixels: np.ndarray) -> Any:
    height, width = pixels.shape[:2]
    return _TYPES["sensor_msgs/msg/Image"](
        header=_header(stamp, topics.COLOR_CAMERA), height=height, width=width, encoding="rgb8", is_bigendian=0,
        step=3 * width, data=np.ascontiguousarray(pixels).reshape(-1),
    )  # fmt: skip


def _camera_info(stamp: int, camera: Camera) -> Any:
    roi = _TYPES["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _TYPES["sensor_msgs/msg/CameraInfo"](
        header=_header(stamp, topics.COLOR_CAMERA), height=camera.size[1], width=camera.size[0],
        distortion_model="plumb_bob", d=np.zeros(5), k=camera.K.reshape(-1), r=np.eye(3).reshape(-1),
        p=np.c_[camera.K, np.zeros(3)].reshape(-1), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip
