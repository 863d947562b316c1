# SPDX-License-Identifier: Apache-2.0
"""`ros2 launch dpm2_ros dpm2.launch.py [bag:=FOLDER] [params:=FILE] [rviz:=false] [embed_mapper:=false] ...`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = Path(get_package_share_directory("dpm2_ros"))

ARGUMENTS = {
    "bag": ("", "rosbag2 folder or .mcap to play; empty: live sensors"),
    "rate": ("1.0", "speed of the bag"),
    "config_file": ("", "YAML file with settings, as for `dpm2 run --config`"),
    "points_topic": ("/kitti/velo/pointcloud", "point clouds"),
    "image_topic": ("/kitti/camera_color_left/image_raw", "images"),
    "embed_mapper": ("true", "the mapper within slam_node; false starts mapper_node beside it"),
    "map_directory": ("dpm2_map", "where the map is saved at the end; empty: nowhere"),
    "namespace": ("", "of all nodes: one a robot"),
    "rviz": ("true", "show the map in RViz"),
    "use_sim_time": ("auto", "follow /clock; auto: with a bag"),
}


def generate_launch_description() -> LaunchDescription:
    """slam_node, and as asked for: mapper_node, bag_player, RViz. All with the Fast DDS profile for large messages."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    with_bag = ["'", value["bag"], "' != ''"]
    asked = ["'", value["use_sim_time"], "' == "]
    sim_time = ParameterValue(
        PythonExpression([*asked, "'true' or (", *asked, "'auto' and ", *with_bag, ")"]), value_type=bool
    )
    parameters = {
        "use_sim_time": sim_time,
        # Typed, since an empty text would otherwise be read as YAML's null.
        "config_file": ParameterValue(value["config_file"], value_type=str),
        "input.points_topic": ParameterValue(value["points_topic"], value_type=str),
        "input.image_topic": ParameterValue(value["image_topic"], value_type=str),
        "ros.embed_mapper": ParameterValue(value["embed_mapper"], value_type=bool),
        "ros.map_directory": ParameterValue(value["map_directory"], value_type=str),
    }
    common = {"package": "dpm2_ros", "namespace": value["namespace"], "output": "screen"}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", str(SHARE / "config" / "fastdds.xml")),
            Node(executable="slam_node", parameters=[parameters], **common),
            Node(
                executable="mapper_node",
                parameters=[parameters],
                condition=UnlessCondition(value["embed_mapper"]),
                **common,
            ),
            Node(
                package="dpm2_ros",
                executable="bag_player",
                output="screen",
                arguments=[value["bag"], "--rate", value["rate"], "--wait", "30"],
                condition=IfCondition(PythonExpression(with_bag)),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(SHARE / "config" / "dpm2.rviz")],
                parameters=[{"use_sim_time": sim_time}],
                condition=IfCondition(value["rviz"]),
            ),
        ]
    )
