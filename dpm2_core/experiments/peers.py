# SPDX-License-Identifier: Apache-2.0
"""Other programs on the same frames: each takes one frame after the other, and returns all poses at the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from dpm2_core.errors import UsageError
from dpm2_core.extras import needs
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3

_MAX_RANGE = 100.0  # m, KISS-ICP's default


class Peer(Protocol):
    """Another odometry or SLAM.

    Attributes:
        at_end: whether its poses are those at the last point of each sweep, see `at_stamps`.
    """

    at_end: bool

    def add(self, frame: Frame) -> None:
        """Process the next frame."""
        ...

    def poses(self) -> Array:
        """(N, 4, 4) T_first_lidar of all frames."""
        ...


class KissIcp:
    """I. Vizzo et al., "KISS-ICP", RA-L 2023, as its pipeline runs it with its defaults."""

    def __init__(self, threads: int, deskew: bool) -> None:
        """`deskew`: whether the points have times.

        Raises:
            UsageError: it is not installed.
        """
        with needs("bench", "the peer kiss-icp"):
            from kiss_icp.kiss_icp import KissICP

        self.at_end = deskew  # it deskews all points to the time of the last one
        self._odometry, self._poses = KissICP(kiss_icp_config(threads, deskew)), list[Array]()

    def add(self, frame: Frame) -> None:
        """As `Peer`."""
        self._odometry.register_frame(*cloud_and_times(frame))
        self._poses.append(np.array(self._odometry.last_pose))

    def poses(self) -> Array:
        """As `Peer`."""
        return np.array(self._poses)


def kiss_icp_config(threads: int, deskew: bool) -> Any:
    """KISS-ICP's configuration, with its defaults for sweeps of 100 m.

    Raises:
        MissingPackageError: it is not installed.
    """
    with needs("bench", "the peer kiss-icp"):
        from kiss_icp.config import load_config

    config = load_config(None)
    config.data.deskew, config.data.max_range = deskew, _MAX_RANGE
    config.mapping.voxel_size = _MAX_RANGE / 100
    config.registration.max_num_threads = threads
    return config


class KissSlam:
    """T. Guadagnino et al., "KISS-SLAM", IROS 2025, as its pipeline runs it with its defaults."""

    def __init__(self, threads: int, deskew: bool) -> None:
        """As `KissIcp`."""
        with needs("peers", "the peer kiss-slam"):
            from kiss_slam.config import load_config
            from kiss_slam.slam import KissSLAM

        config = load_config(None)
        config.odometry.preprocessing.deskew = deskew
        config.odometry.registration.max_num_threads = threads
        self.at_end = deskew  # by KISS-ICP
        self._slam, self._frames = KissSLAM(config), 0

    def add(self, frame: Frame) -> None:
        """As `Peer`."""
        self._slam.process_scan(*cloud_and_times(frame))
        self._frames += 1

    def poses(self) -> Array:
        """As `Peer`; after its last optimization."""
        self._slam.generate_new_node()
        self._slam.local_map_graph.erase_last_local_map()
        found, _ = self._slam.fine_grained_optimization()
        return np.array(found)[-self._frames :]


class SmallGicp:
    """K. Koide, "small_gicp", JOSS 2024: its voxelized GICP, frame to model, from constant velocity."""

    at_end = False

    def __init__(self, threads: int, deskew: bool) -> None:
        """As `KissIcp`; it cannot deskew."""
        with needs("bench", "the peer small_gicp"):
            import small_gicp

        self._library: Any = small_gicp
        self._map = small_gicp.GaussianVoxelMap(1.0)
        self._threads, self._poses = threads, list[Array]()

    def add(self, frame: Frame) -> None:
        """As `Peer`."""
        cloud, _ = self._library.preprocess_points(cloud_and_times(frame)[0], 0.25, 10, self._threads)
        T = np.eye(4) if not self._poses else self._poses[-1]
        if len(self._poses) > 1:
            T = T @ np.linalg.inv(self._poses[-2]) @ T
        if self._poses:
            T = np.asarray(self._library.align(self._map, cloud, T, 3.0, self._threads, 20).T_target_source)
        self._map.insert(cloud, T)
        self._poses.append(T)

    def poses(self) -> Array:
        """As `Peer`."""
        return np.array(self._poses)


PEERS: dict[str, Callable[[int, bool], Peer]] = {"kiss-icp": KissIcp, "kiss-slam": KissSlam, "small_gicp": SmallGicp}


def make_peer(name: str, threads: int, deskew: bool) -> Peer:
    """The program of that name.

    Raises:
        UsageError: no such program, or it is not installed.
    """
    if name not in PEERS:
        raise UsageError(f"--peer {name}: want {', '.join(PEERS)}, or NAME=FILE with a trajectory")
    return PEERS[name](threads, deskew)


def cloud_and_times(frame: Frame) -> tuple[Array, Array]:
    """(M, 3) float64 points without invalid ones, and (M,) their times within the sweep, 0..1; (0,) without times."""
    finite = np.isfinite(frame.points[:, :3]).all(1)
    cloud = frame.points[finite, :3].astype(np.float64)
    if frame.time_offset is None:
        return cloud, np.array([])
    times = frame.time_offset[finite].astype(np.float64)
    span = float(np.ptp(times)) if len(times) else 0.0
    return cloud, (times - times.min()) / span if span > 0 else np.zeros(len(times))


def end_of(frame: Frame) -> int:
    """Time of the last point of a sweep, ns; the stamp if points have no times."""
    if frame.time_offset is None:
        return frame.stamp
    times = frame.time_offset[np.isfinite(frame.points[:, :3]).all(1)]
    return frame.stamp + (round(float(times.max()) * 1e9) if len(times) else 0)


def at_stamps(poses: Array, ends: Sequence[int], stamps: Sequence[int]) -> Array:
    """Convert poses (N, 4, 4) at the `ends` (N,) of sweeps, ns, to those at their `stamps` (N,): interpolated from the
    end of the sweep before; the first one extrapolated from the motion to the second."""
    if len(poses) < 2:
        return poses
    end, stamp = np.asarray(ends, np.float64), np.asarray(stamps, np.float64)
    number = np.arange(len(poses))
    before, after = np.maximum(number - 1, 0), np.maximum(number, 1)
    span, own_fraction = end[after] - end[before], np.minimum(number, 1.0)
    fraction = np.divide(
        stamp - end[before], span, out=own_fraction, where=span > 0
    )  # its own pose where a clock went back
    return se3.interpolated(poses[before], poses[after], np.clip(fraction, -1, 1))
