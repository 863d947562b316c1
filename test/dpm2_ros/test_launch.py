# SPDX-License-Identifier: Apache-2.0
"""What the launch file gives to the nodes starts them.

launch and launch_ros are in no package registry. What is computed here is the launch file's own, plain Python; the
rest of it, which hands that to launch_ros, needs an installation of ROS.
"""

from __future__ import annotations

import functools
import importlib.util
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock, patch

import pytest
import rclpy
import yaml

from dpm2_core.config import flat_fields
from dpm2_ros import executables
from dpm2_ros.parameters import CONFIG_FILE, load_parameters
from dpm2_ros.runtime import ros_context
from dpm2_ros.settings import NodeConfig
from dpm2_ros.share import share_directory
from tools.replay import ros_environment, start

ROOT = Path(__file__).resolve().parents[2]
DEFAULTS = {name: info.get_default(call_default_factory=True) for name, info in flat_fields(NodeConfig)}
MISSING = ("ament_index_python", "launch", "launch_ros")


@pytest.fixture(scope="module")
def launch_file() -> ModuleType:
    path = ROOT / "launch" / "dpm2.launch.py"
    spec = importlib.util.spec_from_file_location("dpm2_launch", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    lines = path.read_text().splitlines()
    imported = {line.split()[1] for line in lines if line.startswith("from ") and line[5:].startswith(MISSING)}
    packages = {name.split(".")[0] for name in imported}
    with patch.dict(sys.modules, {name: MagicMock() for name in imported | packages}):
        spec.loader.exec_module(module)
    return module


def defaults(launch_file: ModuleType) -> dict[str, str]:
    return {name: default for name, (default, _) in launch_file.ARGUMENTS.items()}


def write(parameters: dict[str, Any], path: Path) -> Path:
    """As launch_ros writes them for a node."""
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
    return path


@pytest.mark.parametrize("name", ["slam_node", "mapper_node"])
def test_a_node_starts_from_a_file_of_defaults_and_empty_texts(
    launch_file: ModuleType, ros: Callable[..., Any], tmp_path: Path, name: str
) -> None:
    """Whatever a launch argument may leave empty, `config_file` among them."""
    empty = {
        parameter: ""
        for parameter in launch_file.PARAMETERS.values()
        if isinstance(DEFAULTS.get(parameter, ""), str) and parameter not in ("ros.odom_frame", "ros.odom_source")
    }
    assert CONFIG_FILE in empty
    file = write({"use_sim_time": False} | empty | launch_file.parameters(defaults(launch_file)), tmp_path / "p.yaml")
    harness = ros()
    environment = ros_environment(harness.node.context.get_domain_id())
    process = start(name, ["--ros-args", "--params-file", str(file)], environment, tmp_path / "log")
    try:
        harness.wait(lambda: name in harness.node.get_node_names() or process.poll() is not None, f"{name} to be there")
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0, (tmp_path / "log").read_text()
    finally:
        process.kill()
        process.wait()


def test_arguments_left_alone_override_no_file(launch_file: ModuleType) -> None:
    assert launch_file.parameters(defaults(launch_file)) == {}


def test_every_argument_is_a_parameter_that_is_taken(launch_file: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "settings.yaml").write_text("{}")
    value = defaults(launch_file) | {
        "bag": "drive.mcap",
        "config_file": str(tmp_path / "settings.yaml"),
        "points_topic": "/ouster/points",
        "image_topic": "/cam/image",
        "imu_topic": "/imu/data",
        "base_frame": "base_link",
        "odom_frame": "red/odom",
        "odom_source": "tf",
        "embed_mapper": "false",
        "map_directory": "maps",
        "map_file": "town.dpm2map",
        "localization_mode": "true",
    }
    file = write(launch_file.parameters(value), tmp_path / "p.yaml")
    ros_context(["--ros-args", "--params-file", str(file)])
    try:
        node = rclpy.create_node("any", automatically_declare_parameters_from_overrides=True)
        config = load_parameters(node, NodeConfig)
        assert node.get_parameter("use_sim_time").value is True  # by the bag
    finally:
        rclpy.try_shutdown()
    changed = {name for name, default in DEFAULTS.items() if of(config, name) != default}
    assert changed == set(launch_file.PARAMETERS.values()) - {CONFIG_FILE}
    assert (config.ros.embed_mapper, config.ros.localization_mode, config.ros.map_file) == (False, True, "town.dpm2map")


def test_three_robots_have_namespaces_and_frames_of_their_own(launch_file: ModuleType) -> None:
    value = defaults(launch_file) | {"robots": "red, blue,green", "namespace": "site", "points_topic": "points"}
    found = launch_file.robots(value | {"base_frame": "base_link"})
    assert [namespace for namespace, _ in found] == ["site/red", "site/blue", "site/green"]
    assert launch_file.parameters(found[1][1]) == {
        "input.points_topic": "points",
        "ros.embed_mapper": False,
        "ros.odom_frame": "blue/odom",
        "ros.base_frame": "blue/base_link",
    }
    assert "base_frame" not in launch_file.parameters(launch_file.robots(value)[0][1])
    alone = defaults(launch_file) | {"namespace": "red"}
    assert launch_file.robots(alone) == [("red", alone)]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"robots": "red,red"}, "names that differ"),
        ({"robots": "red,"}, "names that differ"),
        ({"robots": "1st,2nd"}, "names that differ"),
        ({"robots": "a b"}, "names that differ"),
        ({"robots": "red,blue", "embed_mapper": "true"}, "one mapper_node"),
        ({"robots": "red,blue", "localization_mode": "true"}, "one mapper_node"),
    ],
)
def test_robots_that_cannot_be_are_an_error(launch_file: ModuleType, wrong: dict[str, str], message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        launch_file.robots(defaults(launch_file) | wrong)


@pytest.mark.parametrize(
    ("bag", "asked", "given"), [("", "auto", None), ("b", "auto", True), ("b", "false", False), ("", "true", True)]
)
def test_use_sim_time(launch_file: ModuleType, bag: str, asked: str, given: bool | None) -> None:
    value = defaults(launch_file) | {"bag": bag, "use_sim_time": asked}
    assert launch_file.parameters(value).get("use_sim_time") is given


def test_a_parameter_file_that_is_missing_ends_the_launch(launch_file: ModuleType, tmp_path: Path) -> None:
    file = write({}, tmp_path / "p.yaml")
    assert launch_file.parameter_files({"params_file": ""}) == []
    assert launch_file.parameter_files({"params_file": str(file)}) == [str(file)]
    with pytest.raises(RuntimeError, match=r"params_file: no such file: .*/none.yaml"):
        launch_file.parameter_files({"params_file": str(tmp_path / "none.yaml")})


def test_rviz_shows_the_topics_of_the_robot(launch_file: ModuleType) -> None:
    layout = (share_directory() / "config" / "dpm2.rviz").read_text()
    assert launch_file.rviz_remappings(defaults(launch_file), layout) == {}
    value = defaults(launch_file) | {"namespace": "/a/red", "points_topic": "points", "image_topic": "/cam/image"}
    rules = launch_file.rviz_remappings(value, layout)
    shown = set(re.findall(r"Value: (/[\w/]+)", layout))
    assert set(rules) == shown
    assert rules["/kitti/velo/pointcloud"] == "/a/red/points"
    assert rules["/kitti/camera_color_left/image_raw"] == "/cam/image"
    assert rules["/dpm2/map"] == "/a/red/dpm2/map"
    assert rules["/initialpose"] == "/a/red/initialpose"


def test_it_starts_executables_that_exist(launch_file: ModuleType) -> None:
    code = (ROOT / "launch" / "dpm2.launch.py").read_text()
    assert set(re.findall(r'executable="(\w+)"', code)) == {"bag_player", "rviz2"}
    assert set(launch_file.CHOICES) <= set(launch_file.ARGUMENTS)
    assert all(launch_file.ARGUMENTS[name][0] in choices for name, choices in launch_file.CHOICES.items())
    assert "--rate" in code
    assert "--wait" in code


@pytest.mark.parametrize(
    ("given", "nodes", "last"),
    [
        ({}, ["slam_node"], "slam_node"),
        ({"embed_mapper": "false"}, ["slam_node", "mapper_node"], "slam_node"),
        ({"robots": "red,blue"}, ["slam_node", "slam_node", "mapper_node"], "mapper_node"),
    ],
)
def test_the_launch_ends_with_the_node_that_all_depend_on(
    launch_file: ModuleType, given: dict[str, str], nodes: list[str], last: str
) -> None:
    value = defaults(launch_file) | given
    found = [executable for executable, _, _ in launch_file.nodes(value)]
    assert (found, launch_file.ending(value), found.count(last)) == (nodes, last, 1)
    assert set(found) <= set(executables.__dict__)


def of(config: NodeConfig, name: str) -> Any:
    return functools.reduce(getattr, name.split("."), config)
