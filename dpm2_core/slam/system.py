# SPDX-License-Identifier: Apache-2.0
"""The complete SLAM: each frame gives its pose and what changes in the map. Synchronous and deterministic.

`Slam.process` is the algorithm. Every frame goes through the odometry. Every keyframe is added to the map, which closes
loops, or, if the map must not change, is localized in it. The ROS node runs the same object, with its two steps in two
threads. `slam/build.py` creates the parts.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from time import perf_counter

from dpm2_core.data.sweep_parts import SweepParts
from dpm2_core.data.thumbnail import PLACE_WIDTH, thumbnail
from dpm2_core.estimates import Edge, Keyframe, OdometryResult, State
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry.deskew import placed
from dpm2_core.slam.loops.localizer import LocalizationResult, Localizer
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.odometry.odometry import Odometry

_MAX_NEW_LOOPS = 100  # no more loops are found during a frame
_KEYFRAME_TIMEOUT = 10_000_000_000  # ns after which a keyframe that has not reached the map is taken as lost


@dataclass(frozen=True, eq=False)
class MapResult:
    """The result of the map for a keyframe.

    Attributes:
        loops: loops that were tried, accepted or rejected, in a map that grows.
        located: its pose in a map that does not change; None in a map that grows.
    """

    loops: list[Edge]
    located: LocalizationResult | None = None


@dataclass(frozen=True, eq=False)
class SlamResult:
    """The state of the SLAM after one frame.

    Attributes:
        odometry: of every frame.
        map: of a frame that became a keyframe; else None.
        T_map_odom: (4, 4), includes all corrections; None while the pose in the map is not known.
        state: of the odometry; if that is healthy and the map does not change, of the localization.
    """

    odometry: OdometryResult
    map: MapResult | None
    T_map_odom: Array | None
    state: State

    @property
    def T_map_lidar(self) -> Array | None:
        """(4, 4); None while the pose in the map is not known."""
        return None if self.T_map_odom is None else self.T_map_odom @ self.odometry.T_odom_lidar


class Slam:
    """One robot in one map.

    Attributes:
        odometry: processes every frame.
        mapper: the map. It receives every keyframe, unless there is a localizer.
        localizer: localizes every keyframe in the map, which is then not changed; None: the map grows.
        frame: the last frame that was processed, parts of a sweep joined; None before the first.
    """

    def __init__(
        self,
        odometry: Odometry,
        mapper: Mapper,
        localizer: Localizer | None = None,
        thumbnail_width: int = 0,
        pictured: float | None = None,
    ) -> None:
        """Create the SLAM from its parts.

        Args:
            thumbnail_width: width of the image that is stored with every keyframe in a map file, pixels; 0: none.
            pictured: standard deviation of the position in its worst direction, m, above which keyframes have an image
                for relocalization; None: never.
        """
        self.odometry, self.mapper, self.localizer = odometry, mapper, localizer
        self._thumbnail_width = thumbnail_width
        self._pictured = pictured
        self.frame: Frame | None = None
        self._parts = SweepParts()
        self._last: OdometryResult | None = None  # of a whole sweep
        self._T_map_odom: Array | None = None  # of the map that grows, valid until the next keyframe
        self._pending_stamp: int | None = None  # stamp of the keyframe that has not reached the map yet
        # Pairs of odometry keyframe ids that loops connected since its last step; with a localizer there are none.
        self._new_loops: deque[tuple[int, int]] = deque(maxlen=_MAX_NEW_LOOPS)

    @property
    def uses_images(self) -> bool:
        """Whether frames should have their images."""
        return self.odometry.uses_images or self._thumbnail_width > 0

    def process(self, frame: Frame) -> SlamResult:
        """Process one frame. Never raises for data that a sensor may deliver."""
        odometry = self.odometry_step(frame)
        began = perf_counter()
        result = None
        if odometry.keyframe is not None:
            result = self.map_step(odometry.keyframe)
        odometry.seconds["map"] = perf_counter() - began
        return SlamResult(odometry, result, self.T_map_odom, self.state(odometry.state))

    def odometry_step(self, frame: Frame) -> OdometryResult:
        """The frame's pose in the odometry frame, and a keyframe if enough is new or a localizer needs one.

        Frames that are parts of a sweep are joined. The pose of the last part is registered; the others are predicted.
        May run in another thread than `map_step`.
        """
        sweep = self._parts.join(frame)
        if sweep is None and self._last is not None:
            return self.odometry.between(self._last, frame)
        self.frame = sweep or frame
        self._last = self._process_sweep(self.frame)
        return self._last

    def _process_sweep(self, frame: Frame) -> OdometryResult:
        """Of a frame that shows a whole sweep."""
        localizer, pending_stamp = self.localizer, self._pending_stamp
        is_pending = pending_stamp is not None and abs(frame.stamp - pending_stamp) < _KEYFRAME_TIMEOUT
        if localizer is not None and not is_pending and localizer.wants(frame.stamp):
            self.odometry.request_keyframe()
        if localizer is not None and localizer.found is not None:
            self.odometry.cross_breaks(localizer.found)
        while self._new_loops:
            self.odometry.cross_breaks(*self._new_loops.popleft())
        result = self.odometry.process(frame)
        if localizer is not None and result.state is State.LOST:
            localizer.odometry_lost(self.odometry.next_keyframe)
        if result.keyframe is None:
            return result
        self._pending_stamp = frame.stamp
        width = max(self._thumbnail_width, PLACE_WIDTH if self._needs_image(result) else 0)
        image = next((image for image in frame.images if image.camera.name not in result.repeated), None)
        if image is None or not width:
            return result
        picture = thumbnail(placed(image, image.time_offset, result.twist), width)
        return replace(result, keyframe=replace(result.keyframe, thumbnail=picture))

    def begin_drive(self) -> None:
        """Begin the odometry anew: the next frame is the first of another drive."""
        self.odometry.reset()
        self._parts, self._last = SweepParts(), None

    def _needs_image(self, result: OdometryResult) -> bool:
        """Whether a keyframe is searched by its image, now or later, since its points do not determine its pose."""
        registration = result.registration
        return self._pictured is not None and (
            self.localizer is not None
            or registration.method in ("first", "visual")
            or registration.worst_sigma > self._pictured
        )

    def map_step(self, keyframe: Keyframe) -> MapResult:
        """Add a keyframe to the map, or localize it there.

        Raises:
            RejectedError: the keyframe is invalid; see `Mapper.add`.
        """
        self._T_map_odom = None
        if keyframe.stamp == self._pending_stamp:
            self._pending_stamp = None
        if self.localizer is not None:
            return MapResult([], self.localizer.add(keyframe))
        loops = self.mapper.add(keyframe)
        self._note_loops(keyframe, [loop for loop in loops if loop.ok])
        return MapResult(loops)

    def _note_loops(self, keyframe: Keyframe, loops: list[Edge]) -> None:
        """Note the loops of the last keyframe that the graph keeps, by the odometry's ids: below 0 before its start."""
        offset = self.mapper.keyframes[-1].id - keyframe.id
        for loop in self.mapper.kept(loops):
            one, other = (self.mapper.keyframes[node] for node in (loop.from_node, loop.to_node))
            if one.robot == other.robot == keyframe.robot:
                self._new_loops.append((other.id - offset, one.id - offset))

    def use(self, mapper: Mapper, localizer: Localizer | None) -> None:
        """Continue in another map."""
        self.mapper, self.localizer, self._T_map_odom = mapper, localizer, None
        self._new_loops.clear()

    def finish(self) -> None:
        """At the end of a drive: complete the map and its file."""
        if self.localizer is None:
            self.mapper.finish()

    @property
    def T_map_odom(self) -> Array | None:
        """(4, 4); None while the pose in the map is not known."""
        if self.localizer is not None:
            return self.localizer.T_map_odom if self.localizer.state.located else None
        if self._T_map_odom is None:
            self._T_map_odom = self.mapper.T_map_odom
        return self._T_map_odom

    def state(self, odometry: State) -> State:
        """State of the robot, given the state of its odometry."""
        localizer = self.localizer
        if localizer is None or odometry in (State.LOST, State.INITIALIZING) or localizer.state is State.TRACKING:
            return odometry
        return localizer.state
