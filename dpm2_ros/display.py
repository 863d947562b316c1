# SPDX-License-Identifier: Apache-2.0
"""Messages for RViz and Foxglove: optimized path, pose graph with its loops, occupancy grid, projected clouds."""

from __future__ import annotations

import array
import time
from collections.abc import Callable, Generator, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, Vector3
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from dpm2_core.data.frames import Calibration
from dpm2_core.data.projection import painted
from dpm2_core.estimates import Edge
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.mapping.occupancy_map import FREE, OCCUPIED, Grid
from dpm2_ros.conversions import bytes_to_array, header, pose_to_msg, poses_to_msgs

_REST_FACTOR = 4.0  # times the work on one message: least time from its start to that of the next
_NEEDS_REBUILD = -1  # value of `_shown_changes` if the message must be built again
GRAY, GREEN, BLUE, RED = (0.7, 0.7, 0.7), (0.1, 0.8, 0.2), (0.2, 0.5, 1.0), (1.0, 0.2, 0.2)


def path_to_msg(poses: Array, stamps: Sequence[int], frame_id: str) -> Path:
    """(N, 4, 4) optimized poses to nav_msgs/Path; stamps in ns."""
    pairs = zip(stamps, poses_to_msgs(poses), strict=True)
    stamped = [PoseStamped(header=header(stamp, frame_id), pose=pose) for stamp, pose in pairs]
    return Path(header=header(stamps[-1] if stamps else 0, frame_id), poses=stamped)


def pose_graph_to_msg(mapper: Mapper, stamp: int, frame_id: str) -> MarkerArray:
    """Nodes gray, odometry edges green, accepted loops blue, rejected ones red."""
    positions, edges = mapper.poses[:, :3, 3], mapper.edges
    odometry = [edge for edge in edges if edge.kind == "odometry"]
    accepted = [edge for edge in edges if edge.kind == "loop"]
    rejected = {(loop.from_node, loop.to_node): loop for loop in mapper.loops}
    for loop in accepted:
        rejected.pop((loop.from_node, loop.to_node), None)
    parts = (
        (Marker.SPHERE_LIST, GRAY, 0.6, positions),
        (Marker.LINE_LIST, GREEN, 0.15, _end_points(positions, odometry)),
        (Marker.LINE_LIST, BLUE, 0.3, _end_points(positions, accepted)),
        (Marker.LINE_LIST, RED, 0.1, _end_points(positions, list(rejected.values()))),
    )
    markers = []
    for id, (kind, color, size, points) in enumerate(parts):
        marker = Marker(header=header(stamp, frame_id), ns="pose_graph", id=id, type=kind)
        marker.action = Marker.ADD if len(points) else Marker.DELETE
        marker.pose = pose_to_msg(np.eye(4))
        marker.scale = Vector3(x=size, y=size, z=size)
        marker.color = ColorRGBA(r=color[0], g=color[1], b=color[2], a=1.0)
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]
        markers.append(marker)
    return MarkerArray(markers=markers)


def loop_to_msg(loop: Edge, stamp: int, from_name: str, to_name: str) -> DiagnosticArray:
    """The result of a loop candidate, with its reason: OK for an accepted one, WARN for a rejected one."""
    result = loop.registration
    numbers = {"confidence": result.confidence, "overlap": result.overlap, "rmse (m)": result.rmse}
    values = [KeyValue(key="method", value=result.method)]
    values += [KeyValue(key=key, value=f"{value:.3f}") for key, value in numbers.items()]
    status = DiagnosticStatus(
        level=DiagnosticStatus.OK if result.ok else DiagnosticStatus.WARN,
        name=f"loop: {from_name} - {to_name}",
        message="accepted" if result.ok else result.reason,
        values=values,
    )
    return DiagnosticArray(header=header(stamp, from_name), status=[status])


def _end_points(positions: Array, edges: Sequence[Edge]) -> Array:
    """(2 E, 3) end points of E edges."""
    return positions[np.array([(edge.from_node, edge.to_node) for edge in edges], np.intp).reshape(-1)]


def grid_to_msg(grid: Grid, stamp: int, frame_id: str) -> OccupancyGrid:
    """nav_msgs/OccupancyGrid: 100 occupied, 0 free, -1 unknown, the row of the lowest y first."""
    values = np.full(256, -1, np.int8)
    values[[OCCUPIED, FREE]] = 100, 0
    message = OccupancyGrid(header=header(stamp, frame_id))
    message.info.map_load_time = message.header.stamp
    message.info.resolution = grid.resolution
    message.info.height, message.info.width = grid.cells.shape
    message.info.origin = pose_to_msg(se3.make(np.eye(3), [*grid.origin, 0.0]))
    cells = array.array("b")
    cells.frombytes(values[grid.cells[::-1]].tobytes())
    message.data = cells
    return message


class Projection:
    """Images with the cloud projected into them, to check an extrinsic; made only while there is a subscriber."""

    def __init__(self, node: Node, second: bool) -> None:
        """`second`: whether there is a second camera, whose images have their own topic."""
        names = ["dpm2/projection", *["dpm2/second_projection"] * second]
        self._publishers = [node.create_publisher(Image, name, 1) for name in names]

    def show(self, frame: Frame, calibration: Calibration) -> None:
        """Publish each image of a frame."""
        images = {image.camera.name: image for image in frame.images}
        for publisher, camera in zip(self._publishers, calibration.cameras, strict=False):
            image = images.get(camera.topic)
            if image is None or not publisher.get_subscription_count():
                continue
            pixels = painted(image, frame.points)
            height, width = pixels.shape[:2]
            image_header = header(frame.stamp, calibration.frame_of(camera))
            message = Image(header=image_header, height=height, width=width, encoding="rgb8")
            message.step, message.data = 3 * width, bytes_to_array(pixels.tobytes())
            publisher.publish(message)


class Display:
    """A large message that is built only if it has a subscriber, the map has changed, and its period has passed.

    For a large map, the period is longer: after the work on one message, the map's thread has three times as long for
    all other work.
    """

    def __init__(self, publisher: Any, period: Callable[[], float], make: Callable[[], Any]) -> None:
        """`make`: called in the map's thread; returns the message, or a generator that builds it in steps and returns
        it."""
        self._publisher, self._period, self._make = publisher, period, make
        self._shown_changes = 0
        self._started_at, self._work_time = -np.inf, 0.0
        self._is_working = False
        self._steps: Generator[None, None, Any] | None = None  # of the message that is being built

    def due(self, changes: int) -> bool:
        """Whether to publish now; if so, `publish` is expected to follow."""
        if self._is_working:
            return False
        if not self._publisher.get_subscription_count():
            if self._steps is not None:  # the next subscriber gets the map of that time
                self.again()
            return False
        if self._steps is None:
            rest = _REST_FACTOR * self._work_time if self._shown_changes != _NEEDS_REBUILD else 0.0
            period_passed = time.monotonic() - self._started_at >= max(self._period(), rest)
            if changes == self._shown_changes or not period_passed:
                return False
            self._shown_changes, self._started_at, self._work_time = changes, time.monotonic(), 0.0
        self._is_working = True
        return True

    def again(self) -> None:
        """Build the message again, from the start: it was incomplete, or the one being built is outdated."""
        self._steps, self._shown_changes = None, _NEEDS_REBUILD

    def publish(self) -> None:
        """Build and send the message, or do one step of that."""
        begin, steps, self._steps = time.monotonic(), self._steps, None
        try:
            result = steps or self._make()
            if isinstance(result, Generator):
                next(result)
                self._steps = result
            else:
                self._publisher.publish(result)
        except StopIteration as done:
            self._publisher.publish(done.value)
        finally:
            self._work_time += time.monotonic() - begin
            self._is_working = False
