# SPDX-License-Identifier: Apache-2.0
"""A live view of a run in rerun's viewer: the growing map, the pose, loops, the image, states and times."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import BETWEEN, Edge, OdometryResult, State
from dpm2_core.extras import needs
from dpm2_core.frame import Array, Frame
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.system import SlamResult

if TYPE_CHECKING:
    import rerun

_MAX_SCAN_POINTS = 6000  # points of a scan that are shown; all of a keyframe are, in the map
_STATE_COLORS = {State.TRACKING: (90, 200, 120), State.DEGRADED: (240, 180, 60), State.LOST: (230, 80, 70)}
_ACCEPTED_COLOR, _REJECTED_COLOR, _TRAJECTORY_COLOR = (90, 160, 255), (230, 90, 80), (240, 210, 90)
_MAX_IMAGE_WIDTH = 640  # largest width of an image that is shown: encoding a larger one took longer than all the rest
_FLUSH_TIMEOUT = 10.0  # s, for a viewer to receive the remaining data
_VIEWER_PORT = 9876  # of a viewer that runs already, also on another machine: forwarded by ssh


def check_view(viewer: bool, record: Path | None, out: Path) -> None:
    """Raise the errors of a `LiveView` that can be foreseen, before anything is read or written.

    Args:
        out: the folder of the results, which will be made.

    Raises:
        MissingPackageError: the extra `view` is not installed. UsageError: no such folder for the recording.
        Dpm2Error: there is no display.
    """
    with needs("view", "--view and --record"):
        import rerun  # noqa: F401
    if record is not None and not record.parent.is_dir() and record.parent.resolve() != out.resolve():
        raise UsageError(f"--record {record}: no such folder")
    if viewer and not _can_show_viewer():
        raise Dpm2Error("--view: no display for rerun's viewer; use --record FILE.rrd instead")


class LiveView:
    """Shows each frame once it is processed. A context manager: leaving it completes the recording."""

    def __init__(self, name: str, viewer: bool, record: Path | None) -> None:
        """Open rerun's viewer, or a recording, or both.

        See `check_view`.

        Raises:
            MissingPackageError: the extra `view` is not installed. Dpm2Error: the viewer does not start.
        """
        with needs("view", "--view and --record"):
            import rerun
            from rerun import blueprint
        self._rr = rerun
        self._stream = rerun.RecordingStream(f"dpm2 {name}")
        layout = _layout(blueprint)
        if viewer:
            try:
                self._stream.spawn(default_blueprint=layout)
            except Exception as error:
                raise Dpm2Error(
                    f"--view: rerun's viewer does not start: {error}; use --record FILE.rrd instead"
                ) from None
        if viewer and record is not None:
            self._stream.set_sinks(rerun.GrpcSink(), rerun.FileSink(str(record)), default_blueprint=layout)
        elif record is not None:
            self._stream.save(record, default_blueprint=layout)
        self._stages: list[str] = []
        self._shown_keyframes = 0
        self._loops: dict[bool, list[tuple[int, int]]] = {True: [], False: []}

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # the viewer has been closed: its remaining data are not needed
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT)
        self._stream.disconnect()

    def add(self, frame: Frame, result: SlamResult, mapper: Mapper) -> None:
        """Show a frame and its result."""
        tracked = result.odometry
        self._stream.set_time("frame", sequence=tracked.index)
        self._stream.set_time("stamp", timestamp=np.datetime64(tracked.stamp, "ns"))
        T = tracked.T_odom_lidar if result.T_map_lidar is None else result.T_map_lidar
        self._show_scan(frame, T, tracked)
        self._show_figures(tracked)
        if frame.images:
            pixels = frame.images[0].pixels
            step = -(-pixels.shape[1] // _MAX_IMAGE_WIDTH)
            jpeg = cv2.imencode(".jpg", pixels[::step, ::step, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
            self._stream.log("image", self._rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        if tracked.keyframe is not None:
            self._show_map(mapper, () if result.map is None else result.map.loops)

    def _show_scan(self, frame: Frame, T_map_lidar: Array, tracked: OdometryResult) -> None:
        points = frame.points[:: max(1, len(frame.points) // _MAX_SCAN_POINTS), :3]
        points = points[np.isfinite(points).all(1)]
        color = _STATE_COLORS.get(tracked.state, (150, 150, 150))
        self._stream.log("map/lidar", self._pose(T_map_lidar))
        self._stream.log("map/lidar/scan", self._rr.Points3D(points, colors=color, radii=0.05))

    def _show_figures(self, tracked: OdometryResult) -> None:
        if tracked.registration.method == BETWEEN:  # only predicted
            return
        if self._stages != list(tracked.seconds):
            self._stages = list(tracked.seconds)
            self._stream.log("times", self._rr.SeriesLines(names=self._stages), static=True)
            names = ["confidence", "standard deviation of the position, m"]
            self._stream.log("quality", self._rr.SeriesLines(names=names), static=True)
        self._stream.log("times", self._rr.Scalars([1e3 * seconds for seconds in tracked.seconds.values()]))
        sigma = np.sqrt(max(float(np.linalg.eigvalsh(tracked.covariance[3:, 3:])[-1]), 0.0))
        self._stream.log("quality", self._rr.Scalars([tracked.registration.confidence, sigma]))
        if tracked.failed or tracked.state is not State.TRACKING:
            text = f"{tracked.state}: {tracked.registration.reason or tracked.registration.method}"
            level = self._rr.TextLogLevel.ERROR if tracked.failed else self._rr.TextLogLevel.WARN
            self._stream.log("log", self._rr.TextLog(text, level=level))

    def _show_map(self, mapper: Mapper, loops: Sequence[Edge]) -> None:
        """Show new keyframes, and all poses again if a loop has moved them."""
        poses = mapper.poses
        moved = any(loop.ok for loop in loops)
        for node in range(0 if moved else self._shown_keyframes, len(poses)):
            self._stream.log(f"map/keyframes/{node}", self._pose(poses[node]))
        for node in range(self._shown_keyframes, len(poses)):
            cloud = mapper.clouds[node]
            heights = np.clip((cloud[:, 2] + 2.0) / 8.0, 0, 1)[:, None]
            colors = (np.array([70, 110, 150]) * (1 - heights) + np.array([240, 230, 200]) * heights).astype(np.uint8)
            self._stream.log(f"map/keyframes/{node}/cloud", self._rr.Points3D(cloud[:, :3], colors=colors, radii=0.04))
        self._shown_keyframes = len(poses)
        self._stream.log("map/way", self._rr.LineStrips3D([poses[:, :3, 3]], colors=_TRAJECTORY_COLOR, radii=0.1))
        for loop in loops:
            self._loops[loop.ok].append((loop.from_node, loop.to_node))
            verdict = "accepted" if loop.ok else f"rejected: {loop.registration.reason}"
            level = self._rr.TextLogLevel.INFO if loop.ok else self._rr.TextLogLevel.DEBUG
            self._stream.log("log", self._rr.TextLog(f"loop {loop.from_node} - {loop.to_node} {verdict}", level=level))
        for ok, name, color in ((True, "accepted", _ACCEPTED_COLOR), (False, "rejected", _REJECTED_COLOR)):
            if ends := self._loops[ok]:
                strips = [poses[[a, b], :3, 3] for a, b in ends]
                self._stream.log(f"map/loops/{name}", self._rr.LineStrips3D(strips, colors=color, radii=0.08))

    def _pose(self, T: Array) -> rerun.Transform3D:
        return self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def _can_show_viewer() -> bool:
    """Whether a viewer can open or is running: without a display rerun would still start one, and wait forever."""
    if not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        return True
    with socket.socket() as connection:
        return connection.connect_ex(("127.0.0.1", _VIEWER_PORT)) == 0


def _layout(b: Any) -> Any:
    """The map on the left; image, times, quality and log on the right."""
    right = b.Vertical(
        b.Spatial2DView(origin="image", name="image"),
        b.TimeSeriesView(origin="times", name="times, ms"),
        b.TimeSeriesView(origin="quality", name="quality"),
        b.TextLogView(origin="log", name="log"),
    )
    return b.Blueprint(b.Horizontal(b.Spatial3DView(origin="map", name="map"), right, column_shares=[2, 1]))
