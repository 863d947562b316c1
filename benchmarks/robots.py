# SPDX-License-Identifier: Apache-2.0
"""`make bench-robots`: three slam_nodes on overlapping parts of a real road, and one mapper_node behind a bad network.

The mapper has its own network, connected to the robots' by one link that loses packets and is down for 30 s
(`lossy_link`). The robots drive at the same time, along KITTI's sequence 07 in the synthetic city.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.harness import Options
from benchmarks.lossy_link import LOSS, inside, make_link, own_network, start_mapper, switch_link
from benchmarks.roads import open_road, road_files
from dpm2_core.commands.options import run_command
from dpm2_core.console import Console, tracked
from dpm2_core.errors import Dpm2Error, exit_code
from dpm2_core.evaluation.metrics import align, ape_rmse
from dpm2_core.evaluation.record import write_record
from dpm2_core.frame import Array
from dpm2_core.sim.simulated_drive import SimulatedDrive
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.mapping.parts import parts_of
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import MapData, load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.tables import record_table
from dpm2_ros.conversions import cloud_to_msg, parse_keyframe_name
from tools.replay import SpunNode, ros_environment, start, stop

ROAD = "07"
SPANS = {"red": (0, 420), "blue": (340, 760), "green": (680, 1100)}
"""Frames of each robot; green ends where red began."""
EVERY = 2
"""Frames between two scans of a robot. They are sent one second apart, since all four nodes share a machine."""
OUTAGE = (60, 90)
"""Begin and end of the link's outage, s after the robots start."""
_START, _PERIOD = 1_000_000_000, 100_000_000  # ns: stamps; the scans were taken at 10 Hz


class _ScanPublisher(SpunNode):
    """Publishes the scans of all robots, and records the keyframes that they create."""

    def __init__(self, source: SimulatedDrive) -> None:
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import PointCloud2

        from dpm2_ros.mapping import KEEP_ALL

        super().__init__("scans")
        self._source, self.made = source, {name: set[int]() for name in SPANS}
        self._lidars = {name: self._node.create_publisher(PointCloud2, f"/{name}/points", 10) for name in SPANS}
        for name in SPANS:
            self._node.create_subscription(Odometry, f"/{name}/dpm2/keyframe_odom", self._on_keyframe, KEEP_ALL)

    def _on_keyframe(self, message: Any) -> None:
        robot, id, _ = parse_keyframe_name(message.child_frame_id)
        self.made[robot].add(id)

    def connected(self) -> bool:
        """Whether all robots and the mapper are connected."""
        publisher_counts = [self._node.count_publishers(f"/{name}/dpm2/keyframe_odom") for name in SPANS]
        mapper_counts = [self._node.count_publishers(f"/{name}/dpm2/keyframes_received") for name in SPANS]
        return (
            all(publisher_counts)
            and all(mapper_counts)
            and all(lidar.get_subscription_count() for lidar in self._lidars.values())
        )

    def send(self, tick: int) -> None:
        """Publish the next scan of each robot."""
        for name, (first, _) in SPANS.items():
            n = first + EVERY * tick
            points = self._source.frame(n).points
            self._lidars[name].publish(cloud_to_msg(points, _START + n * _PERIOD, f"{name}/lidar"))


def bench(
    out: Annotated[Path, typer.Option(help="Folder for robots.json.")] = Path("benchmarks"),
) -> int:
    """All keyframes in one map, and its error compared with that of one robot that drives the whole road alone."""
    path = next(path for path in road_files(Options()) if path.stem == ROAD)
    source = open_road(path)
    with tempfile.TemporaryDirectory(prefix="dpm2_bench_robots_") as folder:
        data, made, missed = _drive(source, Path(folder))
    errors, alone = _errors(source, data), _single_robot_error(source)
    maps = int(parts_of(data).max()) + 1
    robots = {name: _evaluated(data, name, made[name], errors) for name in SPANS}
    results = {
        "road": ROAD,
        "packet_loss": LOSS,
        "outage": {"seconds": OUTAGE[1] - OUTAGE[0], "keyframes_made_meanwhile": missed},
        "maps": maps,
        "loops_between_robots": sum(
            data.keyframes[edge.from_node].robot != data.keyframes[edge.to_node].robot for edge in data.constraints
        ),
        "ape_rmse_m": _rms(errors),
        "single_robot_ape_rmse_m": alone,
        "robots": robots,
    }
    write_record(out / "robots.json", results, "python -m benchmarks.robots")
    title = f"{maps} map, APE {_rms(errors):.3f} m; of one robot alone {alone:.3f} m"
    columns = {name: f"{{{name}:.4g}}" for name in ("keyframes", "keyframes_missing", "ape_rmse_m")}
    Console().print(record_table(title, ["robot"], columns, robots))
    return 1 if maps > 1 or any(row["keyframes_missing"] for row in robots.values()) else 0


def _drive(source: SimulatedDrive, root: Path) -> tuple[MapData, dict[str, set[int]], int]:
    """The map of all robots, the ids of the keyframes that each created, and how many of them during the outage.

    Raises:
        Dpm2Error: the nodes did not start, or the map did not receive all keyframes.
    """
    environment, path = ros_environment() | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, root / "town.dpm2map"
    processes: list[subprocess.Popen[bytes]] = []
    scans: _ScanPublisher | None = None
    try:
        os.environ.update(environment)  # rclpy in this process reads it when it starts
        make_link()
        parameters = ["--ros-args", "-p", "ros.map_directory:=''", "-p", f"ros.map_file:={path}"]
        mapper = start_mapper(parameters, environment, root / "mapper.log")
        processes.append(mapper)
        scans = _ScanPublisher(source)
        for name in SPANS:
            processes.append(start("slam_node", _arguments(name), environment, root / f"{name}.log"))
        _wait(scans, scans.connected, "robots and mapper to start")
        count = [0, 0]
        first, end = SPANS["red"]
        for tick in tracked(range((end - first) // EVERY), "driving"):
            if tick in OUTAGE:
                count[OUTAGE.index(tick)] = sum(map(len, scans.made.values()))
                switch_link(up=tick != OUTAGE[0])
            scans.send(tick)
            scans.spin(1.0)
        scans.spin(2.0)
        made = scans.made
        _wait(scans, lambda: len(_read(path)) >= sum(map(len, made.values())), "the map to be complete")
        stop(mapper)
        return _read(path), made, count[1] - count[0]
    finally:
        for process in processes:
            process.kill()
            process.wait()
        if scans is not None:
            scans.close()


def _arguments(name: str) -> list[str]:
    parameters = ["input.points_topic:=points", "input.images:=false", "ros.embed_mapper:=false",
             f"ros.odom_frame:={name}/odom", "ros.map_directory:=''"]  # fmt: skip
    return ["--ros-args", "-r", f"__ns:=/{name}", *(part for pair in parameters for part in ("-p", pair))]


def _wait(scans: _ScanPublisher, condition: Any, what: str, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise Dpm2Error(f"waited {seconds:.0f} s for {what}")
        scans.spin(0.5)


def _read(path: Path) -> MapData:
    with MapStore.open(path) as store:
        return load_map(store, descriptors=False)


def _errors(source: SimulatedDrive, data: MapData) -> Array:
    """(K, 3) m: difference of the map's keyframes, aligned as a whole, from their true positions."""
    frames = np.array([(keyframe.stamp - _START) // _PERIOD for keyframe in data.keyframes])
    truth = source.poses[frames]
    T_world_map = align(data.poses[:, :3, 3], truth[:, :3, 3])
    return np.asarray((T_world_map @ data.poses - truth)[:, :3, 3])


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(1).mean()))


def _evaluated(data: MapData, name: str, made: set[int], errors: Array) -> dict[str, float]:
    own = np.array([keyframe.robot == name for keyframe in data.keyframes])
    ids = {keyframe.id for keyframe in data.keyframes if keyframe.robot == name}
    return {"keyframes": len(made), "keyframes_missing": len(made - ids), "ape_rmse_m": _rms(errors[own])}


def _single_robot_error(source: SimulatedDrive) -> float:
    """APE of the keyframes of one robot that drives the whole road in one process, without ROS, m."""
    slam = make_slam(SlamSettings())
    for n in range(0, SPANS["green"][1], EVERY):
        slam.process(source.frame(n))
    slam.mapper.finish()
    frames = [keyframe.index for keyframe in slam.mapper.keyframes]
    return ape_rmse(source.poses[frames], slam.mapper.poses)


if __name__ == "__main__":
    sys.exit(run_command(bench) if inside() else exit_code(lambda: own_network("benchmarks.robots")))
