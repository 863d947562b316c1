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
    """What only the nodes need; topics are in `input`, shared with `dpm2 run`."""

    reliability: Literal["auto", "reliable", "best_effort"] = "auto"
    """Of the subscriptions. auto follows the publishers: best effort as soon as one of them offers no more."""

    queue_depth: int = Field(default=10, ge=1, le=1000)
    """Clouds that may wait for the worker; when full, the oldest is dropped, and counted in /diagnostics. Where clouds
    keep coming faster than they are processed fewer may wait, down to two, until it has caught up."""

    sync_timeout: float = Field(default=0.03, ge=0, le=5)
    """How long a cloud waits for its image before it goes on without, s."""

    map_frame: FrameName = "map"
    """Frame of the optimized map."""

    odom_frame: FrameName = "odom"
    """Frame of the continuous odometry, whosever it is."""

    odom_source: Literal["own", "tf", "topic"] = "own"
    """Whose odometry `odom_frame` belongs to. own: slam_node publishes odom -> base. Else the robot has one already,
    which goes on publishing it: scans are registered from where it leads, map -> odom corrects it, and nobody else is a
    parent of the base. tf: its odom -> base on /tf; topic: nav_msgs/Odometry on `odom_topic`."""

    odom_topic: str = Field(default="odom", min_length=1)
    """nav_msgs/Odometry, with `odom_source` topic."""

    invert_odom_tf: bool = False
    """Publish what slam_node and its mapper know of the pose as children of the base, for a tree that is another's:
    base -> odom -> map, or, with another odometry, the leaf base -> ODOM_FRAME_dpm2 beside map -> odom."""

    base_frame: str = ""
    """Frame whose pose is published. Before /tf_static connects it with the LiDAR no pose is; up to 300 are kept, with
    one more all are discarded, and the drive begins again. Empty takes the root above the LiDAR in /tf_static, also one
    that comes late, else the LiDAR's own frame."""

    tf_timeout: float = Field(default=0.5, ge=0, le=60)
    """How long the first cloud waits for all who publish /tf_static, s."""

    transform_tolerance: Literal["auto"] | Annotated[float, Field(ge=0, le=10)] = "auto"
    """Added to the stamp of map -> odom, so that it is valid until the next one comes, s. Poses at the latest stamps of
    odometry or sensors can be looked up then without an extrapolation into the future. auto: 0.5, or 0 with another
    odometry (`odom_source`), whose error changes with every cloud: exact at the stamps of the clouds."""

    publish_tf_odom: bool = True
    """slam_node publishes odom -> base on /tf, unless `odom_source` is another."""

    publish_tf_map: bool = True
    """The mapper publishes map -> odom on /tf; with a mapper apart beside another odometry (`odom_source`) it publishes
    map -> ODOM_FRAME_dpm2, and slam_node ODOM_FRAME_dpm2 -> odom."""

    embed_mapper: bool = True
    """slam_node hosts the mapper; false where a mapper_node runs apart."""

    map_period: Period = 5.0
    """Least time between two /dpm2/map, s, and four times what one takes to build, of a large map more. It is built
    only while there is a subscriber and it has changed."""

    map_max_points: int = Field(default=200_000, ge=1000, le=10_000_000)
    """Largest /dpm2/map; a larger one is downsampled evenly for publishing, not in memory and not on disk."""

    grid: OccupancySettings = OccupancySettings()
    """Of /dpm2/grid."""

    grid_max_cells: int = Field(default=16_000_000, ge=10_000, le=400_000_000)
    """Largest /dpm2/grid; that of a larger map has cells of twice, four times, ... the edge. 16 million are 16 MB, and
    400 by 400 m at 0.1 m."""

    path_period: Period = 1.0
    """Least time between two /dpm2/path and two /dpm2/pose_graph, s."""

    map_directory: str = "dpm2_map"
    """Folder of the maps, relative to the working directory. Every drive has a name of its own in it: `drive`, with the
    namespace, if any, and a number, if it is taken; nothing is overwritten. NAME.dpm2map grows as the drive goes on;
    ~/save_map, ~/reset and the end of the node write a folder NAME with PLY, TUM and g2o. With the mapper elsewhere
    (`embed_mapper`): keyframes that it does not have yet, NAME.SESSION.unsent, for the next start. Empty: none of
    these."""

    map_name: str = Field(default="", pattern=r"^(\w[\w.-]{0,99})?$")
    """Name within `map_directory`, such as town: ~/save_map also writes NAME.dpm2map, beside the folder NAME, with a
    number where another drive has it; ~/load_map looks for the robot in what was saved last under that name, else in
    NAME.dpm2map. Empty: the drive's own."""

    map_file: str = "auto"
    """Map file that is written as the drive goes on, so that a crash costs no more than a keyframe; `dpm2 map` reads
    it. auto: in `map_directory`; else a path such as town.dpm2map, to which namespace and number are added likewise.
    Empty: none. With `localization_mode`: the path of the map, or folder of tiles, to find oneself in."""

    localization_mode: bool = False
    """slam_node finds itself in `map_file`, which stays as it is, and makes no map of its own."""

    @field_validator("map_directory", "map_file")
    @classmethod
    def _expanded(cls, path: str) -> str:
        return os.path.expanduser(path)  # as a shell does: none reads what stands in a ROS parameter

    @model_validator(mode="after")
    def _different(self) -> RosSettings:
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
        """Of `transform_tolerance`, ns."""
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
    """The core's configuration and that of the nodes."""

    ros: RosSettings = RosSettings()
