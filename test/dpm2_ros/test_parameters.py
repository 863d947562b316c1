# SPDX-License-Identifier: Apache-2.0
"""Every setting is a declared, described, read-only parameter; a mistake is one line and exit code 2."""

from __future__ import annotations

import functools
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter

from dpm2_core.config import flat_fields
from dpm2_core.errors import UsageError
from dpm2_ros.parameters import follow_changes, load_parameters, page
from dpm2_ros.runtime import end_ros, ros_context
from dpm2_ros.settings import CHANGEABLE, NodeConfig

DOCS = Path(__file__).resolve().parents[2] / "docs" / "parameters.md"
Load = Callable[..., tuple[NodeConfig, Node]]


@pytest.fixture
def load(domain: int) -> Iterator[Load]:
    """load(*parameters): configuration and node, with parameters as on the command line."""
    nodes = list[Node]()

    def make(*parameters: str, params_file: Path | None = None) -> tuple[NodeConfig, Node]:
        arguments = ["--ros-args", *(part for pair in parameters for part in ("-p", pair))] if parameters else []
        if params_file is not None:
            arguments = ["--ros-args", "--params-file", str(params_file)]
        end_ros(*nodes)  # of the previous call
        nodes.clear()
        ros_context(arguments, domain)
        nodes.append(rclpy.create_node("parameters", automatically_declare_parameters_from_overrides=True))
        return load_parameters(nodes[-1]), nodes[-1]

    yield make
    end_ros(*nodes)


def test_defaults_are_those_of_the_settings(load: Load) -> None:
    assert load()[0] == NodeConfig()


def test_every_setting_is_declared_described_and_read_only(load: Load) -> None:
    _, node = load()
    for name, info in flat_fields(NodeConfig):
        descriptor = node.describe_parameter(name)
        assert descriptor.description == " ".join(info.description.split()), name
        assert descriptor.read_only == (name not in CHANGEABLE), name
        (result,) = node.set_parameters([Parameter(name, value=node.get_parameter(name).value)])
        assert result.successful == (name in CHANGEABLE), name
    assert dict(flat_fields(NodeConfig)).keys() >= CHANGEABLE


def test_some_change_while_a_node_runs(load: Load) -> None:
    """Parameters change one at a time or together, all or none; invalid values are rejected with the reason, as at the
    start."""
    config, node = load("ros.map_period:=3.0")
    seen: list[NodeConfig] = []
    follow_changes(node, config, seen.append)
    (done,) = node.set_parameters([Parameter("ros.grid.reach", value=12.0)])
    assert done.successful
    assert (seen[-1].ros.grid.reach, seen[-1].ros.map_period) == (12.0, 3.0)
    assert seen[-1].ros.model_copy(update={"grid": config.ros.grid}) == config.ros
    refused = [
        ("ros.map_name", "../town"),
        ("ros.grid.resolution", 1e-30),
        ("ros.grid.reach", 1e9),
        ("ros.grid.lowest", 3.0),  # above the highest: every wall would be free
        ("ros.grid.highest", -1.0),
        ("ros.map_period", "often"),
        ("ros.map_frame", "m"),
    ]
    for name, value in refused:
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful, name
        assert result.reason, name
    both = [Parameter("ros.map_period", value=1.0), Parameter("ros.grid.reach", value=0.0)]
    assert not node.set_parameters_atomically(both).successful
    assert len(seen) == 1
    assert node.get_parameter("ros.map_period").value == 3.0


def test_types_and_ranges(load: Load) -> None:
    _, node = load()
    queue = node.describe_parameter("ros.queue_depth")
    assert queue.type == ParameterType.PARAMETER_INTEGER
    assert (queue.integer_range[0].from_value, queue.integer_range[0].to_value) == (1, 1000)
    timeout = node.describe_parameter("ros.sync_timeout")
    assert timeout.type == ParameterType.PARAMETER_DOUBLE
    assert (timeout.floating_point_range[0].from_value, timeout.floating_point_range[0].to_value) == (0, 5)
    assert "auto or reliable or best_effort" in node.describe_parameter("ros.reliability").additional_constraints


def test_values_of_every_kind(load: Load) -> None:
    config, node = load(
        "ros.queue_depth:=3",
        "ros.sync_timeout:=1",  # ROS reads it as an integer
        "slam.map.voxel:=0.3",
        "ros.reliability:=best_effort",
        "ros.publish_tf_odom:=false",
        "input.T_lidar_cam:=[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]",
        "input.time_field:=''",
    )
    assert (config.ros.queue_depth, config.ros.sync_timeout, config.slam.map.voxel) == (3, 1.0, 0.3)
    assert (config.ros.reliability, config.ros.publish_tf_odom) == ("best_effort", False)
    assert config.input.T_lidar_cam == (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    assert config.input.time_field == ""
    assert node.get_parameter("ros.sync_timeout").value == 1.0
    assert list(node.get_parameter("input.T_lidar_cam").value) == [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def test_parameters_override_the_file(load: Load, tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("ros: {queue_depth: 5, odom_frame: drift}\nslam: {map: {voxel: 0.25}}\n")
    config, node = load(f"config_file:={file}", "ros.queue_depth:=7")
    assert (config.ros.queue_depth, config.ros.odom_frame, config.slam.map.voxel) == (7, "drift", 0.25)
    assert node.get_parameter("config_file").value == str(file)


def test_empty_texts_are_defaults_where_the_default_is_empty(load: Load) -> None:
    """Parameter files and launch files pass empty texts for settings that are not set."""
    empty = [name for name, info in flat_fields(NodeConfig) if info.get_default(call_default_factory=True) == ""]
    config, node = load("config_file:=''", *(f"{name}:=''" for name in empty))
    assert config == NodeConfig()
    assert node.get_parameter("config_file").value == ""


def test_what_was_dumped_can_be_loaded(load: Load, tmp_path: Path) -> None:
    """`ros2 param dump` writes null for a setting without a value, which ROS reads as a string; it is accepted as
    unset."""
    node = load()[1]
    file = tmp_path / "dump.yaml"
    dumped: dict[str, Any] = {}
    for name, _ in flat_fields(NodeConfig):
        value = node.get_parameter(name).value
        *path, leaf = name.split(".")
        functools.reduce(lambda tree, part: tree.setdefault(part, {}), path, dumped)[leaf] = (
            value.tolist() if hasattr(value, "tolist") else value
        )
    assert dumped["input"]["time_field"] is None
    file.write_text(yaml.dump({"/**": {"ros__parameters": dumped}}))
    assert load(params_file=file)[0] == NodeConfig()


def test_a_home_folder_is_meant_by_its_sign(load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`~` is expanded, since no shell looks at parameters."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "settings.yaml").write_text("ros: {queue_depth: 5}\n")
    ros = load("config_file:='~/settings.yaml'", "ros.map_directory:='~/maps'", "ros.map_file:='~/town.dpm2map'")[0].ros
    assert (ros.queue_depth, ros.map_directory, ros.map_file) == (5, f"{tmp_path}/maps", f"{tmp_path}/town.dpm2map")


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("ros.map_frame:=odom", "want different frames for map, odom and base, got odom, odom"),
        ("ros.base_frame:=/map", "want different frames for map, odom and base, got map, odom, map"),
        ("ros.queue_depht:=3", "unknown parameter ros.queue_depht; docs/parameters.md"),
        ("queue_depth:=3", "unknown parameter queue_depth"),
        ("ros.queue_depth:=0", "ROS parameter: ros.queue_depth: .*greater than or equal to 1, got 0"),
        ("ros.queue_depth:=many", "ros.queue_depth: .*valid integer.*got 'many'"),
        ("ros.reliability:=maybe", "'auto', 'reliable' or 'best_effort', got 'maybe'"),
        ("ros.sync_timeout:=.nan", "ros.sync_timeout"),
        ("ros.map_frame:=''", "ros.map_frame"),
        ("input.T_lidar_cam:=[1.0, 2.0]", "input.T_lidar_cam"),
        ("config_file:=/no/such.yaml", "/no/such.yaml: No such file"),
        ("config_file:=5", "config_file: want the path of a file, got 5"),
        ("use_sim_times:=true", "unknown parameter use_sim_times"),
        ("input.points_topic:='bad topic'", "input.points_topic: failed to resolve name: .*alphanumerics.*'bad topic'"),
        ("input.gnss_topic:=1fix", "input.gnss_topic: .*must not start with a number, got '1fix'"),
        ("ros.odom_topic:=x//y", "ros.odom_topic: .*must not contain repeated '/', got 'x//y'"),
        ("qos_overrides./points.subscription.depth:=3", "qos_overrides is not supported; ros.reliability"),
    ],
)
def test_mistakes_are_named(load: Load, parameter: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as error:
        load(parameter)
    assert "\n" not in str(error.value)


def test_a_process_ends_with_2_and_one_line(run: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    """The error is one line, here for an empty list, to which ROS gives no type; other mistakes are tested above."""
    done = run("slam_node", "--ros-args", "-p", "input.T_lidar_cam:=[]")
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 2
    assert "input.T_lidar_cam" in line
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "says"), [(("-p", "nonsense"), "nonsense"), (("--unknown-flag",), "unknown-flag")]
)
def test_malformed_ros_arguments_are_an_error_of_use(arguments: tuple[str, ...], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        ros_context(["--ros-args", *arguments])


def test_the_page_of_parameters_is_up_to_date() -> None:
    assert DOCS.read_text() == page(), "run `make parameters`"


def test_a_preset_changes_what_is_not_given_and_shows_in_the_parameters(load: Load, tmp_path: Path) -> None:
    """It also applies with a settings file: defaults of the file or the node do not count as given."""
    file = tmp_path / "config.yaml"
    file.write_text("slam: {keyframes: {distance: 7.0}}")
    config, node = load("slam.preset:=paper", f"config_file:={file}", "slam.neural.refined:=4")
    assert (config.slam.neural.solver, config.slam.neural.refined, config.slam.keyframes.distance) == (
        "confident",
        4,
        7,
    )
    assert node.get_parameter("slam.neural.solver").value == "confident"


def test_the_parameter_file_of_the_page_sets_what_it_names(load: Load, tmp_path: Path) -> None:
    """The parameter file is used as a reader copies it from docs/ros2.md."""
    (block,) = re.findall(r"^```yaml\n(/\*\*:.*?)^```$", (DOCS.parent / "ros2.md").read_text(), re.M | re.S)
    file = tmp_path / "red.yaml"
    file.write_text(block)
    config = load(params_file=file)[0]
    assert (config.input.points_topic, config.input.imu_topic) == ("ouster/points", "ouster/imu")
    assert config.slam.keyframes.distance == 2.0
    assert (config.ros.base_frame, config.ros.map_directory) == ("base_link", "/home/robot/maps")
