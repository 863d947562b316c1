# SPDX-License-Identifier: Apache-2.0
"""Small generated recordings: a KITTI sequence with a few points per scan, and bags of any messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike

from dpm2_core.data import bag_messages
from dpm2_core.data.messages import cloud_fields, point_columns
from dpm2_core.geometry import se3

CALIB = """P0: 50 0 20 0 0 50 15 0 0 0 1 0
P2: 50 0 20 3 0 50 15 0.1 0 0 1 0.002
Tr: 0 -1 0 0.01 0 0 -1 -0.05 1 0 0 -0.3
"""


@pytest.fixture
def kitti_folder(tmp_path: Path) -> Callable[..., Path]:
    """Creates ROOT/sequences/07 and returns it: `numbers` scans of 60 points, images of 40 x 30, a straight drive."""

    def make(numbers: Sequence[int] = range(5), images: bool = True) -> Path:
        folder, rng = tmp_path / "kitti" / "sequences" / "07", np.random.default_rng(0)
        (folder / "velodyne").mkdir(parents=True)
        (folder / "calib.txt").write_text(CALIB)
        (folder / "times.txt").write_text("".join(f"{0.1 * n:.6e}\n" for n in numbers))
        poses = folder.parents[1] / "poses"
        poses.mkdir()
        (poses / "07.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {n}\n" for n in numbers))
        for n in numbers:
            rng.uniform([-20, -20, -20, 0], [20, 20, 20, 1], (60, 4)).astype("<f4").tofile(
                folder / "velodyne" / f"{n:06d}.bin"
            )
        if images:
            (folder / "image_2").mkdir()
            for n in numbers:
                cv2.imwrite(str(folder / "image_2" / f"{n:06d}.png"), rng.integers(0, 256, (30, 40, 3), dtype=np.uint8))
        return folder

    return make


class BagMaker:
    """Writes rosbag2 recordings message by message."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)

    def new(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """A message such as `new("nav_msgs/Path", header=..., poses=[])`."""
        package, kind = name.split("/")
        return self.store.types[f"{package}/msg/{kind}"](*args, **kwargs)

    def header(self, stamp: float, frame: str = "velo_link") -> Any:
        return bag_messages.header(round(stamp * 1e9), frame)

    def cloud(self, stamp: float, x: float = 1.0, count: int = 60, frame: str = "velo_link") -> Any:
        """`count` points whose x identifies the cloud."""
        return self.cloud_of(stamp, point_columns(np.full((count, 4), [x, 2, 3, 0.5], np.float32)), frame)

    def cloud_of(self, stamp: float, columns: Mapping[str, np.ndarray], frame: str = "velo_link") -> Any:
        fields = cloud_fields(columns, self.store.types["sensor_msgs/msg/PointField"])
        return self.new("sensor_msgs/PointCloud2", header=self.header(stamp, frame), **fields)

    def image(self, stamp: float, value: int = 0, encoding: str = "mono8", size: tuple[int, int] = (8, 6)) -> Any:
        """A gray image whose value identifies it."""
        return self.new("sensor_msgs/Image", header=self.header(stamp, "cam"), height=size[1], width=size[0],
                        encoding=encoding, is_bigendian=0, step=size[0],
                        data=np.full(size[0] * size[1], value, np.uint8))  # fmt: skip

    def info(self, stamp: float) -> Any:
        roi = self.new("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        K = np.array([5, 0, 4, 0, 5, 3, 0, 0, 1.0])
        return self.new("sensor_msgs/CameraInfo", header=self.header(stamp, "cam"), height=6, width=8,
                        distortion_model="plumb_bob", d=np.zeros(5), k=K, r=np.eye(3).reshape(-1), p=np.zeros(12),
                        binning_x=0, binning_y=0, roi=roi)  # fmt: skip

    def transform(self, parent: str, child: str, xyz: Sequence[float], R: ArrayLike | None = None) -> Any:
        return bag_messages.transforms(0, {child: (parent, se3.make(np.eye(3) if R is None else R, xyz))})

    def odometry(self, stamp: float, x: float, child: str = "velo_link") -> Any:
        return bag_messages.odometry(round(stamp * 1e9), child, se3.make(np.eye(3), [x, 0, 0]))

    def write(
        self,
        folder: Path,
        messages: Sequence[tuple[float, str, Any]],
        plugin: str = "MCAP",
        silent: Sequence[tuple[str, str]] = (),
        zstd: bool = False,
        compression: str = "STORAGE",
    ) -> Path:
        """Write messages (log time in s, topic, message or bytes of a cloud). `silent`: (topic, type) of topics without
        messages. `compression`: what `zstd` compresses, STORAGE (the chunks), MESSAGE or FILE."""
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        writer = Writer(folder, version=9, storage_plugin=StoragePlugin[plugin])
        if zstd:
            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        with writer:
            connections: dict[str, Any] = {}
            for topic, kind in silent:
                writer.add_connection(topic, kind, typestore=self.store)
            for time, topic, msg in messages:
                kind = "sensor_msgs/msg/PointCloud2" if isinstance(msg, bytes) else msg.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                data = msg if isinstance(msg, bytes) else self.store.serialize_cdr(msg, kind)
                writer.write(connections[topic], round(time * 1e9), data)
        return folder


@pytest.fixture(scope="session")
def bags() -> BagMaker:
    return BagMaker()
