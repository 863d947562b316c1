# SPDX-License-Identifier: Apache-2.0
"""`ros2 launch dpm2_ros dpm2.launch.py [bag:=FOLDER] [params_file:=FILE] [rviz:=false] ...`; `--show-args` lists all.

An empty argument is not passed to the nodes: files and defaults apply.
"""

import os
import re
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "bag": ("", "rosbag2 folder or .mcap to play; empty: live sensors"),
    "rate": ("1.0", "speed of the bag"),
    "params_file": ("", "ROS parameter file of the nodes"),
    "config_file": ("", "YAML file with settings, as for `dpm2 run --config`"),
    "points_topic": ("", "point clouds; empty: /kitti/velo/pointcloud"),
    "image_topic": ("", "images; empty: /kitti/camera_color_left/image_raw"),
    "imu_topic": ("", "IMU; empty: imu"),
    "base_frame": ("", "frame whose pose is published; empty: the root above the LiDAR in /tf_static"),
    "odom_frame": ("", "frame of the odometry; empty: odom"),
    "odom_source": ("", "tf or topic: the robot has an odometry already; empty: own"),
    "embed_mapper": ("", "true: the mapper within slam_node; false: a separate mapper_node; empty: true"),
    "map_directory": ("", "folder of the maps; empty: ros.map_directory"),
    "map_file": ("", "map file that is written, or, with localization_mode, read; empty: ros.map_file"),
    "localization_mode": ("", "true: slam_node localizes in map_file"),
    "namespace": ("", "namespace of all nodes: one per robot"),
    "robots": ("", "red,blue,green: a slam_node for each, in that namespace, and one mapper_node; empty: one robot"),
    "lifecycle": ("false", "true: slam_node and mapper_node wait for a lifecycle manager"),
    "rviz": ("true", "show the map in RViz, if it is installed"),
    "use_sim_time": ("auto", "follow /clock; auto: with a bag"),
}
CHOICES = {
    "odom_source": ["", "own", "tf", "topic"],
    "lifecycle": ["true", "false"],
    "embed_mapper": ["", "true", "false"],
    "localization_mode": ["", "true", "false"],
    "rviz": ["true", "false"],
    "use_sim_time": ["auto", "true", "false"],
}
_OF_ROS = ("base_frame", "odom_frame", "odom_source", "embed_mapper", "map_directory", "map_file", "localization_mode")
PARAMETERS = {
    "config_file": "config_file",
    **{name: f"input.{name}" for name in ("points_topic", "image_topic", "imu_topic")},
    **{name: f"ros.{name}" for name in _OF_ROS},
}
SAVING = "120"
"""s after Ctrl-C until `launch` sends SIGTERM, and SIGKILL 5 s later; its own 5 s are not enough to save a map."""
SHOWN = {"points_topic": "/kitti/velo/pointcloud", "image_topic": "/kitti/camera_color_left/image_raw"}


def at_home(value: dict[str, str]) -> dict[str, str]:
    """The values with ~ expanded in paths, since no shell does it after `:=`; the nodes expand their own parameters."""
    return value | {name: os.path.expanduser(value[name]) for name in ("bag", "params_file")}


def parameters(value: dict[str, str]) -> dict[str, bool | str]:
    """The nodes' parameters, by the arguments' values."""
    given = {parameter: value[argument] for argument, parameter in PARAMETERS.items()}
    given["use_sim_time"] = value["use_sim_time"]
    if value["use_sim_time"] == "auto":
        given["use_sim_time"] = "true" if value["bag"] else ""
    return {name: {"true": True, "false": False}.get(text, text) for name, text in given.items() if text}


def robots(value: dict[str, str]) -> list[tuple[str, dict[str, str]]]:
    """Namespace of each robot's slam_node, and its arguments' values. /tf is global: each robot has its own frames."""
    if not value["robots"]:
        return [(value["namespace"], value)]
    names = [name.strip() for name in value["robots"].split(",")]
    if len(set(names)) < len(names) or not all(re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) for name in names):
        raise RuntimeError(f"robots: {value['robots']}: want names that differ, such as red,blue")
    if value["embed_mapper"] == "true" or value["localization_mode"] == "true":
        raise RuntimeError(
            "robots: they share one mapper_node, so neither embed_mapper nor localization_mode can be true"
        )
    found = []
    for name in names:
        own = {"embed_mapper": "false", "odom_frame": f"{name}/{value['odom_frame'] or 'odom'}"}
        if value["base_frame"]:
            own["base_frame"] = f"{name}/{value['base_frame']}"
        found.append((f"{value['namespace'].rstrip('/')}/{name}", value | own))
    return found


def nodes(value: dict[str, str]) -> list[tuple[str, str, dict[str, str]]]:
    """Executable, namespace and the arguments' values of each node of dpm2."""
    found = [("slam_node", *robot) for robot in robots(value)]
    if value["embed_mapper"] == "false" or value["robots"]:
        found.append(("mapper_node", value["namespace"], value))
    return found


def ending(value: dict[str, str]) -> str:
    """The executable whose end ends the launch; with several robots, one of them may be restarted."""
    return "mapper_node" if value["robots"] else "slam_node"


def bag_options(value: dict[str, str]) -> list[str]:
    """Options of bag_player: it waits for each slam_node, however slowly it starts; RViz subscribes long before."""
    heard = ["--for", "slam_node", "--subscribers", str(len(robots(value)))]
    return [value["bag"], "--rate", value["rate"], "--wait", "300", *heard]


def parameter_files(value: dict[str, str]) -> list[str]:
    """The parameter file of the user, if any; launch_ros itself only warns if it is missing."""
    file = value["params_file"]
    if file and not Path(file).is_file():
        raise RuntimeError(f"params_file: no such file: {file}")
    return [file] if file else []


def rviz_remappings(value: dict[str, str], layout: str) -> dict[str, str]:
    """Remappings from the topics of the layout (of a robot without namespace, and of KITTI) to those of this robot."""
    here = "/" + "".join(f"{part}/" for part in value["namespace"].split("/") if part)
    rules = {topic: here + topic[1:] for topic in re.findall(r"/(?:dpm2/\w+|initialpose)", layout)}
    for argument, topic in SHOWN.items():
        if requested := value[argument]:
            rules[topic] = requested if requested.startswith("/") else here + requested
    return {topic: target for topic, target in rules.items() if topic != target}


def _typed(given: dict[str, bool | str]) -> list[dict[str, bool | ParameterValue]]:
    """The parameters, with texts marked as texts, so that YAML does not convert them."""
    typed = {n: ParameterValue(v, value_type=str) if isinstance(v, str) else v for n, v in given.items()}
    return [typed] if typed else []


def _actions(context) -> list:
    value = at_home({name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS})
    common = {"package": "dpm2_ros", "output": "screen", "sigterm_timeout": SAVING}
    if value["lifecycle"] == "true":
        common["arguments"] = ["--lifecycle"]
    actions, last = [], ending(value)
    for executable, namespace, own in nodes(value):
        # With the node's name, the arguments override params_file; without it, only some of its entries.
        given = {"name": executable, "namespace": namespace}
        files = [*parameter_files(value), *_typed(parameters(own))]
        ends = Shutdown() if executable == last else None
        actions.append(Node(executable=executable, parameters=files, on_exit=ends, **given, **common))
    if value["bag"]:
        options = bag_options(value)
        actions.append(Node(package="dpm2_ros", executable="bag_player", output="screen", arguments=options))
    if value["rviz"] == "true":
        actions.append(_rviz(value, bool(parameters(value).get("use_sim_time"))))
    return actions


def _rviz(value: dict[str, str], sim_time: bool) -> Node | LogInfo:
    try:
        get_package_share_directory("rviz2")
    except PackageNotFoundError:
        return LogInfo(msg="rviz2 is not installed: nothing is shown")
    layout = Path(get_package_share_directory("dpm2_ros")) / "config" / "dpm2.rviz"
    return Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(layout)],
        parameters=[{"use_sim_time": sim_time}],
        remappings=list(rviz_remappings(value, layout.read_text()).items()),
    )


def generate_launch_description() -> LaunchDescription:
    """Launch slam_node and, if requested, mapper_node, bag_player and RViz."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=CHOICES.get(name))
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_actions)])
