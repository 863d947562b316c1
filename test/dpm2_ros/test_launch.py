# SPDX-License-Identifier: Apache-2.0
"""The nodes start with what the launch file passes to them.

launch and launch_ros are in no package registry. These tests run the launch file's own code, which is plain Python,
and start the processes as launch_ros does, with what the file passes to it.
"""

from __future__ import annotations

import functools
import importlib.util
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import pytest
import rclpy
import yaml
from lifecycle_msgs.msg import Transition
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt32MultiArray

from dpm2_core.config import flat_fields
from dpm2_core.slam.store.check import check_map
from dpm2_ros import executables
from dpm2_ros.mapper_node import MapperNode
from dpm2_ros.parameters import CONFIG_FILE, load_parameters
from dpm2_ros.runtime import end_ros, ros_context
from dpm2_ros.settings import NodeConfig
from dpm2_ros.share import share_directory
from dpm2_ros.slam_node import SlamNode

from ..helpers.lifecycle import Manager

ROOT = Path(__file__).resolve().parents[2]
DEFAULTS = {name: info.get_default(call_default_factory=True) for name, info in flat_fields(NodeConfig)}


@pytest.fixture(scope="module")
def launch_file() -> ModuleType:
    """The launch file, with mocks in place of launch and launch_ros, for which there are no wheels."""
    path = ROOT / "launch" / "dpm2.launch.py"
    spec = importlib.util.spec_from_file_location("dpm2_launch", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    missing = ("ament_index_python", "launch", "launch_ros")
    lines = path.read_text().splitlines()
    imported = {line.split()[1] for line in lines if line.startswith("from ") and line[5:].startswith(missing)}
    packages = {name.split(".")[0] for name in imported}
    with patch.dict(sys.modules, {name: MagicMock() for name in imported | packages}):
        spec.loader.exec_module(module)
    return module


def defaults(launch_file: ModuleType) -> dict[str, str]:
    return {name: default for name, (default, _) in launch_file.ARGUMENTS.items()}


def write(parameters: dict[str, Any], path: Path, node: str = "/**") -> Path:
    """Write parameters as launch_ros does for a node; `node`: its full name, if the launch file sets one."""
    path.write_text(yaml.safe_dump({node: {"ros__parameters": parameters}}))
    return path


@pytest.mark.parametrize("kind", [SlamNode, MapperNode])
def test_a_node_starts_from_a_file_of_defaults_and_empty_texts(
    launch_file: ModuleType, domain: int, tmp_path: Path, kind: type[SlamNode] | type[MapperNode]
) -> None:
    """Empty texts are accepted for all parameters that a launch argument may leave empty, including `config_file`."""
    empty = {
        parameter: ""
        for parameter in launch_file.PARAMETERS.values()
        if isinstance(DEFAULTS.get(parameter, ""), str) and parameter not in ("ros.odom_frame", "ros.odom_source")
    }
    assert CONFIG_FILE in empty
    quick = {"slam.registration": "geometric", "slam.loops.descriptors": False}  # without loading the network
    given = {"use_sim_time": False} | quick | empty | launch_file.parameters(defaults(launch_file))
    file = write(given, tmp_path / "p.yaml")
    ros_context(["--ros-args", "--params-file", str(file)], domain)
    nodes = list[Any]()
    try:
        nodes.append(kind())
        nodes[0].close()
    finally:
        end_ros(*nodes)


def test_arguments_left_alone_override_no_file(launch_file: ModuleType) -> None:
    assert launch_file.parameters(defaults(launch_file)) == {}


def test_every_argument_is_a_parameter_that_is_taken(launch_file: ModuleType, tmp_path: Path, domain: int) -> None:
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
    ros_context(["--ros-args", "--params-file", str(file)], domain)
    node = rclpy.create_node("any", automatically_declare_parameters_from_overrides=True)
    try:
        config = load_parameters(node)
        assert node.get_parameter("use_sim_time").value is True  # because of the bag
    finally:
        end_ros(node)
    changed = {name for name, default in DEFAULTS.items() if of(config, name) != default}
    assert changed == set(launch_file.PARAMETERS.values()) - {CONFIG_FILE}
    assert (config.ros.embed_mapper, config.ros.localization_mode, config.ros.map_file) == (False, True, "town.dpm2map")


@pytest.mark.parametrize("sections", [["slam_node"], ["/**", "slam_node"], ["slam_node", "/**"]])
@pytest.mark.parametrize("namespace", ["", "red"])
def test_an_argument_overrides_the_parameter_file_whatever_sections_that_has(
    launch_file: ModuleType, tmp_path: Path, domain: int, namespace: str, sections: list[str]
) -> None:
    """rcl keeps the sections of all files in the order of their first appearance, and the last one takes precedence."""
    kept, lost = {"input.image_topic": "/of_the_file"}, {"input.points_topic": "/of_the_file"}
    own = f"{namespace}/slam_node".lstrip("/")
    tree = {
        own if s == "slam_node" else s: {"ros__parameters": kept | (lost if s == "slam_node" else {})} for s in sections
    }
    (tmp_path / "user.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
    value = defaults(launch_file) | {"points_topic": "/argument", "params_file": str(tmp_path / "user.yaml")}
    value |= {"namespace": namespace, "rviz": "false"}
    ((_, words),) = commands(launch_file, value, tmp_path)
    ros_context(words, domain)
    node = rclpy.create_node("slam_node", automatically_declare_parameters_from_overrides=True)
    try:
        config = load_parameters(node)
    finally:
        end_ros(node)
    assert (config.input.points_topic, config.input.image_topic) == ("/argument", "/of_the_file")


def test_launch_waits_until_a_map_is_saved(launch_file: ModuleType, tmp_path: Path) -> None:
    """Launch waits at least 60 s from SIGINT to SIGTERM, so that a map can be saved; SIGKILL follows 5 s later. 10 s
    were not enough on a busy machine."""
    commands(launch_file, defaults(launch_file) | {"embed_mapper": "false", "rviz": "false"}, tmp_path)
    given = {call.kwargs["executable"]: call.kwargs for call in launch_file.Node.call_args_list}
    assert set(given) == {"slam_node", "mapper_node"}
    assert all(float(node["sigterm_timeout"]) >= 60 for node in given.values())


@pytest.mark.parametrize(("names", "count"), [("", "1"), ("red,blue", "2")])
def test_the_bag_waits_for_each_slam_node(launch_file: ModuleType, tmp_path: Path, names: str, count: str) -> None:
    """The player waits for subscribers named slam_node only, since RViz receives the clouds before any of them."""
    value = defaults(launch_file) | {"bag": "drive.mcap", "robots": names, "rviz": "false"}
    words = dict(commands(launch_file, value, tmp_path))["bag_player"]
    assert words[words.index("--for") + 1] == "slam_node"
    assert words[words.index("--subscribers") + 1] == count


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


def commands(launch_file: ModuleType, value: dict[str, str], folder: Path) -> list[tuple[str, list[str]]]:
    """Executable and arguments of each process, as launch_ros makes them from what the file passes to it."""
    launch_file.Node.reset_mock()
    launch_file.LaunchConfiguration.side_effect = lambda name: SimpleNamespace(perform=lambda context: context[name])
    launch_file.ParameterValue.side_effect = lambda text, value_type: value_type(text)
    launch_file.generate_launch_description()
    launch_file.OpaqueFunction.call_args.kwargs["function"](value)
    found = []
    for number, node in enumerate(call.kwargs for call in launch_file.Node.call_args_list):
        name, namespace = node.get("name"), f"/{node.get('namespace', '')}".rstrip("/")
        full = f"{namespace}/{name}" if name else "/**"
        files = [
            given if isinstance(given, str) else str(write(given, folder / f"{number}_{k}.yaml", full))
            for k, given in enumerate(node.get("parameters", ()))
        ]
        remap = ["-r", f"__ns:={namespace}"] if namespace else []
        remap += ["-r", f"__node:={name}"] if name else []
        ros = ["--ros-args", *remap, *(word for file in files for word in ("--params-file", file))]
        found.append((node["executable"], [*node.get("arguments", ()), *ros]))
    return found


def test_paths_may_begin_at_home(launch_file: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`~` is expanded in `params_file:=~/mine.yaml` and in the bag's path: no shell expands text after `:=`."""
    monkeypatch.setenv("HOME", str(tmp_path))
    file = write({}, tmp_path / "mine.yaml")
    value = defaults(launch_file) | {"bag": "~/drive.mcap", "params_file": "~/mine.yaml", "rviz": "false"}
    words = dict(commands(launch_file, value, tmp_path))
    assert str(file) in words["slam_node"]
    assert words["bag_player"][0] == str(tmp_path / "drive.mcap")


@pytest.mark.slow
def test_what_it_starts_with_lifecycle_is_managed_over_the_services(
    launch_file: ModuleType, ros: Callable[..., Any], drive: Any, tmp_path: Path
) -> None:
    """A robot's slam_node and the separate mapper_node, from nothing to a map file and back, and to their exit."""
    fast = {"input.images": False, "slam.loops.descriptors": False, "slam.registration": "geometric"}
    file, maps = write(fast | {"slam.keyframes.distance": 1.0}, tmp_path / "fast.yaml"), tmp_path / "maps"
    value = defaults(launch_file) | {"lifecycle": "true", "embed_mapper": "false", "namespace": "red", "rviz": "false"}
    value |= {"params_file": str(file), "map_directory": str(maps), "points_topic": "points"}
    harness = ros()
    clouds, odom = harness.publisher(PointCloud2, "/red/points"), harness.hear(Odometry, "/red/dpm2/odom")
    received = harness.hear(UInt32MultiArray, "/red/dpm2/keyframes_received")
    parts = commands(launch_file, value, tmp_path)
    running = {name: harness.start(name, words, tmp_path / name) for name, words in parts}
    slam, mapper = managers = [Manager(harness, f"/red/{name}") for name in ("slam_node", "mapper_node")]
    assert [manager.state for manager in managers] == ["unconfigured"] * 2
    assert not maps.exists()
    assert all(manager.change(Transition.TRANSITION_CONFIGURE) for manager in managers)
    assert not clouds.get_subscription_count()
    assert all(manager.change(Transition.TRANSITION_ACTIVATE) for manager in (mapper, slam))
    harness.wait(clouds.get_subscription_count, "the subscription to the clouds")
    for n in range(6):
        clouds.publish(drive.cloud(n))
        harness.wait(lambda n=n: len(odom) > n, f"the odometry of cloud {n}")
    harness.wait(lambda: received and received[-1].data[0] >= 3, "keyframes in the map file")
    assert all(manager.change(Transition.TRANSITION_DEACTIVATE) for manager in managers)
    harness.wait(lambda: not clouds.get_subscription_count(), "the end of the subscription")
    assert [manager.state for manager in managers] == ["inactive"] * 2
    assert all(manager.change(Transition.TRANSITION_CLEANUP) for manager in managers)
    assert [manager.state for manager in managers] == ["unconfigured"] * 2
    (path,) = maps.glob("*.dpm2map")
    result = check_map(path)
    assert (result.problems, result.keyframes >= 3) == ([], True)
    for process in running.values():
        process.send_signal(signal.SIGINT)
    assert {name: process.wait(180) for name, process in running.items()} == {"slam_node": 0, "mapper_node": 0}
