# SPDX-License-Identifier: Apache-2.0
"""The whole SLAM: odometry makes keyframes, the mapper makes them consistent. Synchronous and deterministic."""

from __future__ import annotations

from time import perf_counter

from dpm2_core.frame import Frame, OdometryResult
from dpm2_core.slam.build import make_localizer, make_mapper, make_odometry
from dpm2_core.slam.loops.localizer import LocalizationResult
from dpm2_core.slam.mapping.thumbnail import thumbnail
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_store import MapStore


class SlamSystem:
    """One robot: `odometry` runs on every frame, `mapper` on every keyframe; the ROS node runs them in two threads."""

    def __init__(self, settings: SlamSettings | None = None, robot: str = "", store: MapStore | None = None) -> None:
        """`store`: the map file to write, or to go on with; its session has begun."""
        self._settings = settings or SlamSettings()
        self.odometry = make_odometry(self._settings, robot)
        self.mapper = make_mapper(self._settings, store)

    def process(self, frame: Frame) -> OdometryResult:
        """Take one frame in: its pose in the odometry frame, and the map one keyframe richer when it shows enough."""
        tracked = self.odometry.process(frame)
        started = perf_counter()
        if tracked.keyframe is not None:
            self.mapper.add(tracked.keyframe, thumbnail(frame, self._settings.map.thumbnail))
        tracked.seconds["map"] = perf_counter() - started
        return tracked

    def reset(self) -> None:
        """Begin anew, with an empty map; one in a file stays as it is."""
        self.odometry.reset()
        self.mapper = make_mapper(self._settings)


class LocalizationSystem:
    """One robot in a map that stays as it is: `odometry` runs on every frame, `localizer` on every keyframe."""

    def __init__(self, settings: SlamSettings, store: MapStore, robot: str = "") -> None:
        """`store`: the map file, open for reading only, see `open_for_localization`."""
        self.odometry = make_odometry(settings, robot)
        self.mapper = make_mapper(settings, store)
        self.localizer = make_localizer(settings, self.mapper)

    def process(self, frame: Frame) -> tuple[OdometryResult, LocalizationResult | None]:
        """Take one frame in: its pose in the odometry frame, and, when it became a keyframe, its place in the map.

        While the localizer's `state.located`, `T_map_odom @ T_odom_lidar` is the frame's pose in the map.
        """
        if self.localizer.wants(frame.stamp):
            self.odometry.request_keyframe()
        tracked = self.odometry.process(frame)
        started = perf_counter()
        located = None if tracked.keyframe is None else self.localizer.add(tracked.keyframe)
        tracked.seconds["localise"] = perf_counter() - started
        return tracked, located
