# SPDX-License-Identifier: Apache-2.0
"""Settings of the nodes: frames, queues, what is published. `NodeConfig` adds them to those of the core."""

from __future__ import annotations

import os
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from dpm2_core.config import Settings
from dpm2_core.data.naming import frame_name
from dpm2_core.slam.mapping.occupancy_map import OccupancySettings
from dpm2_core.slam.settings import Config

FrameName = Annotated[str, Field(pattern=r"^[^/\s]\S*$")]
Period = Annotated[float, Field(ge=0.1, le=3600)]


class RosSettings(Settings):
    """Settings that only the nodes need. Topics are in `input`, shared with `dpm2 run`."""

    reliability: Literal["auto", "reliable", "best_effort"] = "auto"
    """Reliability (QoS) of the subscriptions. auto follows the publishers: best effort if at least one of them offers
    only best effort."""

    queue_depth: int = Field(default=10, ge=1, le=1000)
    """Largest number of clouds in the input queue; of clouds that are parts of a sweep, the number of sweeps. When it
    is full, the oldest cloud, or the oldest sweep, is dropped and counted in /diagnostics. While clouds arrive faster
    than they are processed, the limit shrinks, down to two, until the worker has caught up."""

    sync_timeout: float = Field(default=0.03, ge=0, le=5)
    """How long a cloud waits for its image before it is processed without it, s."""

    map_frame: FrameName = "map"
    """Frame of the optimized map."""

    odom_frame: FrameName = "odom"
    """Frame of the continuous odometry: that of slam_node, or another one (`odom_source`)."""

    odom_source: Literal["own", "tf", "topic"] = "own"
    """Source of the odometry in `odom_frame`. own: slam_node publishes odom -> base. tf or topic: the robot already has
    an odometry, which continues to publish odom -> base. Scan registration starts from its pose, map -> odom corrects
    it, and dpm2 publishes no parent of the base. tf: reads odom -> base on /tf; topic: reads nav_msgs/Odometry on
    `odom_topic`."""

    odom_topic: str = Field(default="odom", min_length=1)
    """Topic of nav_msgs/Odometry, used with `odom_source` topic."""

    invert_odom_tf: bool = False
    """Publish the poses of slam_node and its mapper as children of the base, for a TF tree in which another node
    publishes the parent of the base: base -> odom -> map. With another odometry: the leaf base -> ODOM_FRAME_dpm2, in
    addition to map -> odom."""

    base_frame: str = ""
    """Frame whose pose is published. No pose is published before /tf_static connects this frame with the LiDAR. The
    poses of up to 30 s are kept until then; with later ones, all are discarded and the drive begins again. Empty: the
    root frame above the LiDAR in /tf_static, also if it arrives late, else the LiDAR's own frame."""

    tf_timeout: float = Field(default=0.5, ge=0, le=60)
    """How long the first cloud waits for all publishers of /tf_static, s."""

    transform_tolerance: Literal["auto"] | Annotated[float, Field(ge=0, le=10)] = "auto"
    """Added to the stamp of map -> odom, so that the transform is valid until the next one arrives, s. Poses at the
    latest stamps of odometry or sensors can then be looked up without an extrapolation into the future. auto: 0.5, or 0
    with another odometry (`odom_source`). The error of that one changes with every cloud, and with 0 the transform is
    exact at the stamps of the clouds."""

    publish_tf_odom: bool = True
    """slam_node publishes odom -> base on /tf, unless `odom_source` is tf or topic."""

    publish_tf_map: bool = True
    """The mapper publishes map -> odom on /tf. With a separate mapper_node and another odometry (`odom_source`), the
    mapper publishes map -> ODOM_FRAME_dpm2, and slam_node publishes ODOM_FRAME_dpm2 -> odom."""

    embed_mapper: bool = True
    """Run the mapper inside slam_node; false if a separate mapper_node runs."""

    map_period: Period = 5.0
    """Least time between two /dpm2/map messages, s. For a large map it is longer: four times the time that one message
    takes to build. The message is built only while there is a subscriber, and only if the map has changed."""

    map_max_points: int = Field(default=200_000, ge=1000, le=10_000_000)
    """Largest number of points of /dpm2/map. A larger map is downsampled evenly for publishing, not in memory and not
    on disk."""

    grid: OccupancySettings = OccupancySettings()
    """Settings of /dpm2/grid."""

    grid_max_cells: int = Field(default=16_000_000, ge=10_000, le=400_000_000)
    """Largest number of cells of /dpm2/grid. The grid of a larger map has cells of twice, four times, ... the edge
    length. 16 million cells are 16 MB, and cover 400 by 400 m at 0.1 m."""

    path_period: Period = 1.0
    """Least time between two /dpm2/path messages, and between two /dpm2/pose_graph messages, s."""

    map_directory: str = "dpm2_map"
    """Folder of the maps, relative to the working directory. Each drive has its own name in it: `drive`, followed by
    the namespace, if there is one, and by a number, if the name is taken; nothing is overwritten. NAME.dpm2map grows
    during the drive; ~/save_map, ~/reset and the end of the node write a folder NAME with PLY, TUM and g2o files. With
    a separate mapper_node (`embed_mapper`), NAME.SESSION.unsent stores the keyframes that it does not have yet, for the
    next start. Empty: none of these."""

    map_name: str = Field(default="", pattern=r"^(\w[\w.-]{0,99})?$")
    """Name within `map_directory`, such as town. ~/save_map also writes NAME.dpm2map, next to the folder NAME, with a
    number if another drive has this name. ~/load_map localizes the robot in the map that was saved last under this
    name, else in NAME.dpm2map. Empty: the drive's own name."""

    map_file: str = "auto"
    """Map file that is written during the drive, so that a crash loses at most one keyframe; `dpm2 map` reads it. auto:
    in `map_directory`; else a path such as town.dpm2map, to which namespace and number are added in the same way.
    Empty: no file. With `localization_mode`: the path of the map, or of the folder of tiles, to localize in."""

    localization_mode: bool = False
    """slam_node localizes in `map_file`, which is not changed, and builds no map of its own."""

    @field_validator("map_directory", "map_file")
    @classmethod
    def _expand_home(cls, path: str) -> str:
        return os.path.expanduser(path)  # no shell expands ~ in a ROS parameter

    @model_validator(mode="after")
    def _check_frames_differ(self) -> RosSettings:
        frames = [self.map_frame, self.own_frame, frame_name(self.base_frame)]
        if self.own_frame != self.odom_frame:
            frames.append(self.odom_frame)
        if len(set(frames)) < len(frames):
            raise ValueError(f"want different frames for map, odom and base, got {', '.join(filter(None, frames))}")
        return self

    @property
    def own_frame(self) -> str:
        """Frame of slam_node's own odometry."""
        return self.odom_frame if self.odom_source == "own" else f"{self.odom_frame}_dpm2"

    @property
    def ahead(self) -> int:
        """`transform_tolerance` in ns, with auto resolved."""
        usual = 0.5 if self.odom_source == "own" else 0.0
        return round((usual if self.transform_tolerance == "auto" else self.transform_tolerance) * 1e9)


CHANGEABLE = frozenset(
    f"ros.{name}"
    for name in (
        "map_name", "map_period", "map_max_points", "path_period", "grid_max_cells",
        "grid.resolution", "grid.lowest", "grid.highest", "grid.reach",
    )
)  # fmt: skip
"""Parameters that can be set while a node runs."""


class NodeConfig(Config):
    """Configuration of the core and of the nodes."""

    ros: RosSettings = RosSettings()
