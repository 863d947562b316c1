# SPDX-License-Identifier: Apache-2.0
"""A bag player in this process, and a node that makes frames from it as slam_node does, and records them."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import rclpy
from nav_msgs.msg import Odometry

from dpm2_core.data import naming
from dpm2_core.data.frames import FrameBuilder
from dpm2_core.data.settings import InputSettings
from dpm2_core.frame import Frame
from dpm2_ros.bag_player import BagPlayer, Options
from dpm2_ros.guard import GuardedNode
from dpm2_ros.settings import RosSettings
from dpm2_ros.subscriptions import Inputs

OPTIONS = Options(
    bag=Path(), rate=1.0, start=0.0, duration=None, loop=False, topics=(), wait=90.0, subscribers=1, clock=False,
    log=None,
)  # fmt: skip


def play(bag: Path, lockstep: bool = True, **options: Any) -> None:
    """Play a bag in this process, to its end."""
    player = rclpy.create_node("bag_player", use_global_arguments=False)
    try:
        BagPlayer(player, replace(OPTIONS, bag=bag, lockstep=lockstep, **options)).play()
    finally:
        player.destroy_node()


class Listener(GuardedNode):
    """Makes frames as slam_node does, and publishes an odometry for each.

    Args:
        second: topic of a second LiDAR. gnss: topic of fixes. busy: delay before a cloud is processed, s.
    """

    def __init__(self, second: str = "", gnss: str = "", busy: float = 0.0, **options: Any) -> None:
        super().__init__("listener", **options)
        self.frames: list[Frame] = []
        self.stepped: list[bool] = []
        settings = InputSettings(points_topic=naming.POINTS, second_points_topic=second, gnss_topic=gnss)
        self.declare_parameter("input.second_points_topic", second)
        self._busy = busy
        self._odometry = self.create_publisher(Odometry, "dpm2/odom", 10)
        inputs = self._inputs = Inputs(self, settings, RosSettings(sync_timeout=0.3))
        log = self.get_logger().error
        self._builder = FrameBuilder(settings, inputs.calibration, log, imu=inputs.imu, gnss=inputs.gnss)
        self._ended = threading.Event()
        self._worker = threading.Thread(target=self._work)
        self._worker.start()

    def _work(self) -> None:
        while not self._ended.is_set():
            if (bundle := self._inputs.take(0.1)) is not None:
                time.sleep(self._busy)
                self.stepped.append(bundle.stepped)
                self.frames.append(self._builder.frame(bundle.stamp, bundle.cloud, len(self.frames), bundle.beside))
                self._odometry.publish(Odometry(header=bundle.cloud.header))

    def close(self) -> None:
        self._ended.set()
        self._worker.join()


def contents(frame: Frame) -> list[Any]:
    """All contents of a frame, bit for bit."""
    images = [
        (i.pixels.tobytes(), i.camera.K.tobytes(), i.camera.T_lidar_cam.tobytes(), i.camera.size, i.camera.distortion)
        for i in frame.images
    ]
    offset = None if frame.time_offset is None else frame.time_offset.tobytes()
    imu = None if frame.imu is None else [frame.imu.stamps.tolist(), frame.imu.rates.tobytes()]
    fix = None if frame.fix is None else frame.fix.stamp
    return [frame.index, frame.stamp, frame.problem, frame.points.tobytes(), offset, images, imu, fix, frame.up]
