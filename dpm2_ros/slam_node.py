# SPDX-License-Identifier: Apache-2.0
"""slam_node: receives clouds and images, publishes odometry, keyframes and (with the mapper embedded) the map."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np
from nav_msgs.msg import Odometry

from dpm2_core.data.frames import Calibration, FrameBuilder
from dpm2_core.descriptors import is_level
from dpm2_core.errors import UsageError
from dpm2_core.estimates import BETWEEN, Keyframe, OdometryResult, State
from dpm2_core.frame import Array, Frame, Up
from dpm2_core.geometry import se3
from dpm2_core.geometry.sweep import Sweep
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.loops.localizer import LOST
from dpm2_core.slam.system import Slam
from dpm2_ros.base_frame import BaseFrame
from dpm2_ros.conversions import BodyMotion, keyframe_to_base, odometry_to_msg
from dpm2_ros.display import Projection
from dpm2_ros.health import Health
from dpm2_ros.keyframe_sender import KeyframeSender, weights_identity
from dpm2_ros.lifecycle import ManagedNode
from dpm2_ros.mapping import MapperThread
from dpm2_ros.other_odometry import OtherOdometry
from dpm2_ros.requests import Requests
from dpm2_ros.runtime import lower_priority
from dpm2_ros.slam_diagnostics import Diagnostics
from dpm2_ros.state import StatePublisher
from dpm2_ros.subscriptions import Inputs
from dpm2_ros.synchronizer import Bundle
from dpm2_ros.tf import TransformBroadcaster
from dpm2_ros.warm_up import warm_up

HELD = 30_000_000_000
"""ns: poses of that time are kept while the base frame is unknown; with later ones the drive begins again."""


class SlamNode(ManagedNode):
    """The node of the odometry. The executor's thread only fills a queue, a worker thread processes it, and the mapper
    has a thread of its own.

    Raises:
        UsageError: a parameter that is not allowed.
    """

    def __init__(self, managed: bool = False) -> None:
        super().__init__("slam_node")
        ros = self._config.ros
        self._has_other_odometry = ros.odom_source != "own"
        if ros.localization_mode and not ros.embed_mapper:
            raise UsageError("ros.localization_mode: needs ros.embed_mapper")
        if self._has_other_odometry and ros.invert_odom_tf and not ros.embed_mapper:
            raise UsageError("ros.invert_odom_tf: needs ros.embed_mapper if ros.odom_source is not own")
        self.start(managed)

    def configure(self, undo: ExitStack) -> None:
        """See `ManagedNode`."""
        ros, weights = self._config.ros, weights_identity(self._config.slam)
        self._slam = self._open_map(undo).active.slam if ros.embed_mapper else make_slam(self._config.slam, self._robot)
        self._health = Health()
        self._sender = KeyframeSender(self, self._robot, ros, weights)
        undo.callback(self._sender.close)
        self._odom = self.create_publisher(Odometry, "dpm2/odom", 10)
        self._state = StatePublisher(self)
        self._projection = Projection(self, second=bool(self._config.input.second_image_topic))
        # Starts no thread with an embedded mapper, whose thread then does this work.
        self._keyframe_executor = ThreadPoolExecutor(1, thread_name_prefix="keyframes", initializer=lower_priority)
        undo.callback(self._keyframe_executor.shutdown)
        # A leaf, or a part of map -> odom.
        sends_odom_link = ros.invert_odom_tf if ros.embed_mapper else ros.publish_tf_map
        is_enabled = sends_odom_link if self._has_other_odometry else ros.publish_tf_odom
        self._tf = TransformBroadcaster(self, ros.own_frame, is_enabled, ros.invert_odom_tf)
        self._stopping = threading.Event()
        self._base = BaseFrame(ros.base_frame, (ros.odom_frame, ros.own_frame, ros.map_frame))
        self._requests = Requests(self, self._mapper, self._base, ros.map_frame)
        self._base_wait_is_over = False  # whether the wait for the base frame is over
        self._lidar_frame = ""  # of the last cloud
        warm_up(self._config.slam)
        self._last_calibration: Calibration | None = None
        self._last_released: Bundle | None = None  # `left` of the synchronizer that a deactivation ended
        self._begin_drive()
        undo.callback(self._report_unpublished)
        self._index = 0

    def activate(self, undo: ExitStack) -> None:
        """Receive clouds from now on; an earlier drive continues, if there was one."""
        ros, self._base_wait_is_over = self._config.ros, False
        self._health = Health()  # its counts are reported together with those of the inputs, which are new too
        self._stopping.clear()
        self._other = None
        if self._has_other_odometry:
            self._other = OtherOdometry(self, ros, lambda: self._inputs.calibration.transforms)
        # Subscribe last: when a publisher sees the subscriptions, the node is ready, and no cloud is lost.
        input_settings = self._config.input.model_copy(
            update={"images": self._config.input.images and self._slam.uses_images}
        )
        self._inputs = Inputs(self, input_settings, ros, self._last_calibration)
        self._last_calibration = self._inputs.calibration
        self._inputs.synchronizer.follow(self._last_released)
        self._frames = FrameBuilder(
            input_settings,
            self._last_calibration,
            self.get_logger().error,
            imu=self._inputs.imu,
            gnss=self._inputs.gnss,
        )
        keyframes = self._sender if self._mapper is None else self._mapper
        self._diagnostics = Diagnostics(self, self._inputs, self._frames, self._health, keyframes, self._base)
        self._diagnostics.other, self._diagnostics.tf = self._other, self._tf
        worker = threading.Thread(target=self._work, name="worker")
        worker.start()
        undo.callback(self._end_worker, worker)
        self.get_logger().info(f"waiting for clouds on {self._inputs.subscriptions[0].topic}")

    @property
    def slam(self) -> Slam:
        """The SLAM system of this node."""
        return self._slam

    @property
    def calibration(self) -> Calibration:
        """Calibration of the sensors, as far as it is known."""
        return self._inputs.calibration

    def _end_worker(self, worker: threading.Thread) -> None:
        """End the worker after the cloud that it is processing."""
        self._stopping.set()
        worker.join()
        self._last_released = self._inputs.synchronizer.left
        self.get_logger().info(self._diagnostics.account())

    def _begin_drive(self) -> None:
        """Set the state to that of a drive at its start."""
        self._slam.begin_drive()
        self._base.restart()
        self._sweep = Sweep()
        self._held_results: list[OdometryResult] = []  # until the base frame is known
        self._up: Up | None = None  # `Frame.up` of the whole drive
        self._covariance = np.zeros((6, 6))
        self._last_motion: BodyMotion | None = None  # the last registered frame, to which `_covariance` refers
        self._unsent_motion: BodyMotion | None = None  # last frame, if the other odometry was not known at its stamp

    def _work(self) -> None:
        while not self._stopping.is_set():
            bundle = self._inputs.take(timeout=0.1)
            if self._requests.reset.is_set():
                self._requests.reset.clear()
                self._end_drive(MapperThread.reset)
            if bundle is None:
                continue
            try:
                self._process(bundle)
            except Exception as error:  # a bug: the drive continues, and /diagnostics counts it
                error.add_note(f"of the cloud at {bundle.stamp} ns")
                self.fail("cloud", error)

    def _end_drive(self, map_action: Callable[[MapperThread], None]) -> None:
        """Let the next cloud begin another drive; `map_action`: what is done with the map of an embedded mapper.

        A separate mapper is notified before it receives the next odometry.
        """
        self._begin_drive()
        if self._mapper is not None:
            map_action(self._mapper)
        else:
            wait([self._keyframe_executor.submit(self._sender.restart)])

    def _restart_drive(self, reason: str) -> None:
        """Begin another drive in the same map, if one has begun already."""
        if self._last_motion is None and not self._held_results:
            return
        self.get_logger().warning(
            f"{reason}: the odometry restarts, its pose in the map is unknown until a loop is found"
        )
        self._end_drive(lambda mapper: mapper.restart(self._robot))

    def _process(self, bundle: Bundle) -> None:
        """Process one frame, from the received messages to the published ones."""
        lidar_frame, before = bundle.cloud.header.frame_id or "lidar", self._lidar_frame
        if lidar_frame != before and before:
            self._restart_drive(f"clouds come in frame {lidar_frame}, no longer in {before}")
            self._base.forget()
            self._base_wait_is_over = False
        elif bundle.restarted:
            self._restart_drive("time went back by more than a second (a looped bag, a clock that was set)")
        self._lidar_frame = lidar_frame
        self._find_base(lidar_frame)
        if self._last_motion is None and not self._held_results:  # fixed per drive: its scans are leveled the same way
            x, y, z = self._base.T_start_lidar[2, :3].tolist()
            self._up = (x, y, z) if self._base.name else None  # for the base, and so in odom
        self._frames.up = self._up
        frame = self._frames.frame(bundle.stamp, bundle.cloud, self._index, bundle.beside)
        tracked = self._track(replace(frame, dropped=bundle.dropped, stepped=bundle.stepped))
        if tracked.imu and tracked.registration.method == "first":  # on the level; /diagnostics may miss one cloud
            self.get_logger().warning(f"{self.calibration.imu_topic}: {tracked.imu}")
        self._index += 1
        self._held_results.append(tracked)
        if self._base.name:
            for held in self._held_results:
                tracked = self._publish_result(held)
            self._held_results = []
        elif tracked.stamp - self._held_results[0].stamp > HELD:
            self._report_unpublished()
            self._begin_drive()
        self._health.add(tracked, time.monotonic() - bundle.arrival)
        if self._slam.frame is not None and tracked.registration.method != BETWEEN:
            self._projection.show(self._slam.frame, self.calibration)
        if (scale := self._slam.odometry.scale) != self._health.scale:
            if scale:  # empty where the drive has just begun again
                self.get_logger().info(f"slam.preset auto: {scale}, by what the scans show")
            self._health.scale = scale

    def _track(self, frame: Frame) -> OdometryResult:
        """One step of the odometry, with the pose of another odometry as a guess, if there is one."""
        other, base = self._other, self._base
        if other is None or not base.name:
            return self._slam.odometry_step(frame)
        at = frame.stamp + round(self._sweep.look(frame) * 1e9)  # where the scan is registered
        guess = other.guess(at, base.name, base.T_base_start @ base.T_start_lidar)
        tracked = self._slam.odometry_step(replace(frame, guess=guess))
        if tracked.registration.method != BETWEEN and (problem := other.judge(tracked.comparison)):
            self.get_logger().warning(f"{other.source}: {problem}", throttle_duration_sec=5)
        return tracked

    def _report_unpublished(self) -> None:
        """Log that the poses that are kept will not be published."""
        if self._held_results:
            self.get_logger().error(f"{len(self._held_results)} poses not published; {self._base.problem}")

    def _find_base(self, lidar_frame: str) -> None:
        """Before the first pose, wait for the latched messages while the queue has room; then follow /tf_static."""
        base, inputs, known, ros = self._base, self._inputs, self._inputs.calibration, self._config.ros
        end, room = time.monotonic() + ros.tf_timeout, max(ros.queue_depth - 1, 1)
        while not self._base_wait_is_over:
            is_found = inputs.calibrated(lidar_frame) and (base.optional or base.look(known.transforms, lidar_frame))
            is_full = inputs.synchronizer.filled >= room
            self._base_wait_is_over = is_found or is_full or self._stopping.is_set() or time.monotonic() >= end
            if not self._base_wait_is_over:
                time.sleep(0.01)
        before = base.name
        if base.look(known.transforms, lidar_frame) and before:
            self.get_logger().warning(
                f"/tf_static now has {base.name} above {before}: from now on its pose is published, in the "
                f"same odom; set ros.base_frame to wait for it"
            )
        if base.problem:
            self.get_logger().error(base.problem, throttle_duration_sec=10)
        if base.child_problem and ros.publish_tf_odom and not self._has_other_odometry and not ros.invert_odom_tf:
            self._diagnostics.tf_problem = f"no {ros.odom_frame} -> {base.name} on /tf: {base.child_problem}"
            self.get_logger().warning(self._diagnostics.tf_problem, once=True)

    def _publish_result(self, tracked: OdometryResult) -> OdometryResult:
        """Pass the keyframe to the map, publish pose and transforms; returns what was published."""
        mapper, T_start_lidar = self._mapper, self._base.T_start_lidar
        T_start_odom = T_start_lidar @ se3.inverse(self._slam.odometry.T_start)
        if tracked.keyframe is not None:
            make = partial(self._finish_keyframe, tracked.keyframe, T_start_lidar, T_start_odom)
            if mapper is not None:
                mapper.add(make)
            else:
                self._keyframe_executor.submit(make).add_done_callback(self._report)
        tracked = replace(tracked, keyframe=None, state=self._slam.state(tracked.state))
        self._publish(tracked, BodyMotion.of_lidar(tracked).of_base(T_start_lidar, T_start_odom))
        self._state.send(tracked)
        return tracked

    def _publish(self, tracked: OdometryResult, motion: BodyMotion) -> None:
        ros, before, covariance, seconds = self._config.ros, self._last_motion, self._covariance, 0.1
        if before is not None:  # the last one that was registered
            A = se3.adjoint(se3.inverse(motion.T_odom_body) @ before.T_odom_body)
            covariance = A @ covariance @ A.T + motion.covariance
            seconds = max((motion.stamp - before.stamp) * 1e-9, 1e-3)
        if before is None or tracked.registration.ok:
            self._last_motion, self._covariance = motion, covariance
        if tracked.state is State.LOST:
            covariance = covariance + LOST
        A = se3.adjoint(self._base.T_base_start)
        motion, covariance = motion.of_other(self._base.T_base_start), A @ covariance @ A.T
        self._odom.publish(odometry_to_msg(motion, covariance, seconds, ros.own_frame, self._base.name))
        if ros.invert_odom_tf or (self._other is None and not self._base.child_problem):
            self._tf.send(motion.T_odom_body, motion.stamp, self._base.name)
        if not (tracked.state is State.LOST and self._mapper is not None and self._mapper.active.localizer is not None):
            self._send_map_transform(motion)  # in localization mode, a lost odometry gives no pose in the map

    def _send_map_transform(self, motion: BodyMotion) -> None:
        """Send odom in the map; or, with a separate mapper, the frame of another odometry in slam_node's own.

        The pose of another odometry at the end of a sweep may arrive late: it is then used with the next cloud.
        """
        ros, T_own_odom, before = self._config.ros, None, self._unsent_motion
        self._unsent_motion = None
        if self._other is not None:
            if before is not None:
                self._send_map_transform(before)
                self._unsent_motion = None  # stamps do not go back
            T_odom_base = self._other.T_odom_base(motion.stamp, self._base.name)
            if T_odom_base is None:  # nothing to correct
                self._unsent_motion = None if self._other.problem else motion
                return
            T_own_odom = se3.orthonormalized(motion.T_odom_body @ se3.inverse(T_odom_base))
        if self._mapper is not None:
            self._mapper.broadcast(motion.stamp, self._robot, ros.odom_frame, T_own_odom)
        elif T_own_odom is not None:
            self._tf.send(T_own_odom, motion.stamp + ros.ahead, ros.odom_frame)

    def _finish_keyframe(self, keyframe: Keyframe, T_base_lidar: Array, T_start_odom: Array) -> Keyframe:
        """Send the keyframe and return it, in the base's frame; not called in the worker's thread. Its descriptors are
        those of a level LiDAR."""
        x, y, z = T_base_lidar[2, :3].tolist()
        if keyframe.up is None and not is_level(T_base_lidar[2, :3]):  # of a drive that began before the base was known
            keyframe = replace(keyframe, up=(x, y, z), descriptors=None)
        keyframe = self._slam.mapper.described(keyframe)
        if not np.array_equal(T_base_lidar, np.eye(4)):
            keyframe = keyframe_to_base(keyframe, T_base_lidar, T_start_odom)
        self._sender.send(keyframe)
        return keyframe

    def _report(self, done: Future[Keyframe]) -> None:
        if (error := done.exception()) is not None:
            self.fail("keyframe", error)
