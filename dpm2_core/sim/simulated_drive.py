# SPDX-License-Identifier: Apache-2.0
"""Drives through synthetic worlds as sources of frames, simulated on request without files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import IndexedSource
from dpm2_core.data.trajectory import FRAME_PERIOD
from dpm2_core.frame import Array, Frame, Inertial
from dpm2_core.geometry import se3
from dpm2_core.sim.imu import Imu
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.road import Road
from dpm2_core.sim.settings import ImuConfig, LidarConfig, PresetName
from dpm2_core.sim.world import World, build_world

_LIDAR_STREAM, _IMU_STREAM = 12, 13  # of random numbers, different from those of the other parts of a world
_POSE_STEP = 0.01  # s between two poses of a robot, with interpolation in between
_MAX_RATE = np.radians(100.0)  # rad/s
_RAMP_TIME = 0.25  # s, duration of a change of the angular rate
_SPEED_PERIOD = 12.0  # s, period of the speed


class _SimulatedSource(IndexedSource):
    """A drive with a LiDAR and no other sensor.

    Attributes:
        world: the world of the drive. times: (N,) s. poses: (N, 4, 4) exact T_world_lidar at these times.
    """

    truth = "simulation"
    poses: Array

    def __init__(self, name: str, world: World, times: Array) -> None:
        super().__init__(name, len(times))
        self.world, self.times = world, times

    def __len__(self) -> int:
        return len(self.times)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1, simulated ahead in another thread."""
        return prefetch(super().frames(start, stop))


class SimulatedDrive(_SimulatedSource):
    """The drive along a road, with traffic, at 10 Hz."""

    def __init__(self, road: str, preset: PresetName, seed: int, name: str) -> None:
        """`road`, `preset` and `seed` as in `build_world`, `name` as in `Source`.

        Raises:
            UsageError: no such road or preset.
        """
        world = build_world(road, preset, seed)
        super().__init__(name, world, world.road.times)
        self._lidar = Lidar(LidarConfig())
        self.poses = np.stack([self._lidar.pose(world, float(t)) for t in self.times])

    def frame(self, position: int) -> Frame:
        """See `IndexedSource`."""
        time = float(self.times[position])
        rng = np.random.default_rng([self.world.seed, _LIDAR_STREAM, position])
        scan = self._lidar.scan(self.world, self.poses[position], time, rng)
        return Frame(round(time * 1e9), scan.points, index=position)


@dataclass(frozen=True)
class Ride:
    """Motion of a LiDAR along a road.

    Attributes:
        speed: largest speed, m/s. turns: occasional rotations to either side, deg; 0: none.
        shakes: amplitudes (rad and m) and frequencies (Hz) of a sine about and along each axis, x to z.
        slows: share of the speed by which it slows down and speeds up again every 12 s.
    """

    speed: float
    turns: float = 0.0
    shakes: tuple[tuple[float, ...], tuple[float, ...]] = ((0.0,) * 6, (1.0,) * 6)
    slows: float = 0.0

    def shaken(self, times: Array) -> Array:
        """(N, 4, 4) deviations at times (N,), s, from the pose without shakes; they begin when the motion begins."""
        amplitudes, frequencies = (np.array(part) for part in self.shakes)
        swing = amplitudes * np.sin(2 * np.pi * frequencies * times[:, None] + np.arange(6))
        return se3.exp(_start_ramp(times)[:, None] * swing)


RIDES = {
    "car": Ride(10.0),
    "walking": Ride(1.4, shakes=((0.02, 0.035, 0.04, 0.01, 0.02, 0.025), (1.0, 2.0, 0.8, 2.0, 1.0, 2.0))),
    "waved": Ride(1.4, shakes=((0.08, 0.08, 0.35, 0.03, 0.05, 0.05), (0.9, 1.1, 0.5, 2.0, 1.0, 1.5))),
    "legged": Ride(1.0, shakes=((0.03, 0.02, 0.03, 0.006, 0.015, 0.012), (2.0, 4.0, 2.0, 4.0, 2.0, 4.0))),
    "drone": Ride(5.0, shakes=((0.15, 0.15, 0.2, 0.3, 0.4, 0.2), (0.4, 0.35, 0.2, 0.3, 0.3, 0.25))),
}
"""On a car, carried by a walker, waved by hand, on a trotting four-legged robot, and below a drone."""


class TurningRobot(_SimulatedSource):
    """A robot that drives along a road and rotates fast. Scans are raw, with the time of each point, from poses that
    change within a sweep, stamped in the middle of the sweep; there may be an IMU."""

    def __init__(
        self,
        world: World,
        frames: int,
        ride: Ride,
        lidar: LidarConfig,
        imu: ImuConfig | None = None,
    ) -> None:
        """Stands for 1 s, then drives, slower in curves: without shakes no rotation is faster than 100 deg/s."""
        rng = np.random.default_rng([world.seed, _IMU_STREAM])
        end = frames * FRAME_PERIOD + 1
        world = replace(world, road=_robot_progress(world.road, end, ride, rng))
        times = 0.5 + np.arange(frames, dtype=np.float64) * FRAME_PERIOD
        super().__init__(f"{world.preset} {world.seed}", world, times)
        self._lidar = Lidar(lidar)
        instants = np.arange(0.0, end, _POSE_STEP)
        level = np.stack([self.world.drive_pose(t, lidar.height, float(_start_ramp(t))) for t in instants])
        self._T = level @ ride.shaken(instants)
        self.poses = self.pose(self.times)
        self._imu = None if imu is None else Imu(imu, rng)
        if self._imu is not None:
            instants = self._imu.times(0.1, end - 0.1)
            self._rates, self._forces = (a @ self._imu.R_lidar_imu.T for a in self._imu.measure(instants, self.pose))
            self._stamps = np.round(instants * 1e9).astype(np.int64)

    def pose(self, times: Array) -> Array:
        """T_world_lidar (M, 4, 4) at times (M,) s."""
        k = np.floor(times / _POSE_STEP).astype(int)
        return se3.interpolated(self._T[k], self._T[k + 1], times / _POSE_STEP - k)

    def frame(self, position: int) -> Frame:
        """See `IndexedSource`; its IMU samples are those since the sweep before."""
        time, T = float(self.times[position]), self.poses[position]
        offsets = self._lidar.beams.column_time.astype(float)
        T_stamp_column = se3.inverse(T) @ self.pose(time + offsets)
        rng = np.random.default_rng([self.world.seed, _LIDAR_STREAM, position])
        scan = self._lidar.scan(self.world, T, time, rng, T_stamp_column)
        stamp, imu = round(time * 1e9), None
        if self._imu is not None:
            end = time + float(offsets.max())
            first, last = np.searchsorted(
                self._stamps, [round((end - (FRAME_PERIOD if position else 1)) * 1e9), round(end * 1e9)]
            )
            imu = Inertial(self._stamps[first:last], self._rates[first:last], self._forces[first:last])
        return Frame(stamp, scan.points, scan.time_offset, index=position, imu=imu)


def _start_ramp(time: ArrayLike) -> Array:
    """0 while the robot is at rest, 1 after its start, with a ramp in between; at times, s."""
    return np.clip((np.asarray(time) - 1.5) / 1.0, 0, 1)


def _robot_progress(road: Road, end: float, ride: Ride, rng: np.random.Generator) -> Road:
    """The road with the progress and heading of a robot that drives for `end` s."""
    times = np.arange(0.0, end + 1, _POSE_STEP)
    s, curvature = road.drive.s, np.abs(np.diff(road.drive.yaw) / np.diff(road.drive.s))
    max_speeds = np.minimum(ride.speed, _MAX_RATE / np.maximum(curvature, 1e-3))
    speed_factors = _start_ramp(times) * (1 - ride.slows * (1 - np.cos(2 * np.pi * times / _SPEED_PERIOD)) / 2)
    travelled = np.zeros(len(times))
    for k in range(1, len(times)):
        segment = int(np.searchsorted(s, travelled[k - 1] % road.drive.length, "right")) - 1
        max_speed = max_speeds[min(segment, len(max_speeds) - 1)]
        travelled[k] = travelled[k - 1] + _POSE_STEP * max_speed * speed_factors[k]
    rate, k, side = np.zeros(len(times)), round(2.5 / _POSE_STEP), 1
    while ride.turns and k < len(times):
        turn = np.radians(ride.turns) * rng.uniform(0.5, 1)
        ramp, steady = round(_RAMP_TIME / _POSE_STEP), max(round((turn / _MAX_RATE - _RAMP_TIME) / _POSE_STEP), 1)
        shape = np.concatenate([np.linspace(0, 1, ramp), np.ones(steady), np.linspace(1, 0, ramp)]) * _MAX_RATE
        for sign in (side, -side):  # to the side and back
            part = rate[k : k + len(shape)]
            part += sign * shape[: len(part)]
            k += len(shape) + round(rng.uniform(0.2, 1.0) / _POSE_STEP)
        side = -side
    return replace(road, times=times, travelled=travelled, slip=np.cumsum(rate) * _POSE_STEP)


def wheel_odometry(T_world_base: Array, slip: float = 0.0, jump: float = 0.0) -> Array:
    """Poses (N, 4, 4) of an odometry with its own origin: each step is longer by the fraction `slip`, and the step to
    the middle frame by `jump` m more."""
    poses = [se3.exp([0.0, 0.0, 2.0, 50.0, -20.0, 0.0])]
    for n, (before, now) in enumerate(pairwise(T_world_base), 1):
        step = se3.way(before, now)
        step[3:] *= 1 + slip
        step[3] += jump * (n == len(T_world_base) // 2)
        poses.append(poses[-1] @ se3.exp(step))
    return np.array(poses)
