# SPDX-License-Identifier: Apache-2.0
"""The package as pip, colcon, ros2 and RViz find it."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import pytest
import yaml
from rclpy.node import Node

from dpm2_ros import build_tf2_msgs
from dpm2_ros.runtime import end_ros, ros_context
from dpm2_ros.share import share_directory
from tools.replay import ros_environment

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = ("slam_node", "mapper_node", "bag_player")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel that `pip install .` installs, built from a copy, since building leaves files behind."""
    out = tmp_path_factory.mktemp("wheel")
    copy = out / "source"
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    for name in filter(None, files):
        if not name.startswith(("test/", "benchmarks/")) and (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
    command = [sys.executable, "setup.py", "-q", "bdist_wheel", "-d", str(out)]
    environment = {name: value for name, value in os.environ.items() if name != "ROS_DISTRO"}
    subprocess.run(command, cwd=copy, env=environment, check=True, capture_output=True)
    (path,) = out.glob("*.whl")
    return zipfile.ZipFile(path)


def test_the_wheel_has_what_ros2_looks_for(wheel: zipfile.ZipFile) -> None:
    names = [re.sub(r"^.*\.data/data/", "", name) for name in wheel.namelist()]
    for requested in (
        "share/ament_index/resource_index/packages/dpm2_ros",
        "share/dpm2_ros/package.xml",
        "share/dpm2_ros/config/fastdds.xml",
        "share/dpm2_ros/config/dpm2.rviz",
        "share/dpm2_ros/launch/dpm2.launch.py",
        *(f"lib/dpm2_ros/{name}" for name in EXECUTABLES),
        "dpm2_core/slam/system.py",
        "dpm2_core/network/presets/small.yaml",
        "dpm2_core/weights/small.safetensors",
        "dpm2_ros/slam_node.py",
    ):
        assert requested in names
    assert not any(name.startswith(("test/", "build/")) for name in names)


def test_ros2_run_starts_the_console_script_of_its_own_environment(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    stub = next(name for name in wheel.namelist() if name.endswith("lib/dpm2_ros/slam_node"))
    assert wheel.getinfo(stub).external_attr >> 16 & 0o111 == 0o111  # pip keeps executable files executable
    for folder in ("lib/dpm2_ros", "bin"):
        (tmp_path / folder).mkdir(parents=True)
    path, script = tmp_path / "lib" / "dpm2_ros" / "slam_node", tmp_path / "bin" / "slam_node"
    path.write_bytes(wheel.read(stub))
    script.write_text('#!/bin/sh\necho "script: $1|$2"\n')
    for file in (path, script):
        file.chmod(0o755)
    done = subprocess.run([str(path), "a b", "c"], capture_output=True, text=True, check=True)
    assert done.stdout == "script: a b|c\n"


def test_dpm2_is_on_the_path_of_a_workspace(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    """colcon installs console scripts in lib/dpm2_ros for `ros2 run`; its environment has bin on PATH, where dpm2
    is."""
    source = Path(str(wheel.filename)).parent / "source"
    command = [sys.executable, "setup.py", "-q", "install", "--prefix", str(tmp_path), "--no-compile"]
    command += ["--single-version-externally-managed", "--record", str(tmp_path / "record")]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (packages,) = tmp_path.glob("**/site-packages")
    environment = os.environ | {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(packages)}
    done = subprocess.run(["dpm2", "version"], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() in wheel.filename
    assert (tmp_path / "lib" / "dpm2_ros" / "slam_node").is_file()
    assert not any(name.endswith("/bin/dpm2") for name in wheel.namelist())  # pip makes its own


def test_console_scripts_lead_to_functions(wheel: zipfile.ZipFile) -> None:
    import importlib

    entries = next(name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    lines = [line for line in wheel.read(entries).decode().splitlines() if "=" in line]
    assert {line.split(" = ")[0] for line in lines} == {*EXECUTABLES, "dpm2"}
    for line in lines:
        module, function = line.split(" = ")[1].split(":")
        assert callable(getattr(importlib.import_module(module), function))


def test_ros_wheels_are_required_unless_ros_is_there(tmp_path: Path) -> None:
    """With ROS sourced, the wheels would shadow it; without, the wheels provide ROS."""
    for distribution, requested in (("", True), ("jazzy", False)):
        environment = os.environ | {"ROS_DISTRO": distribution}
        command = [sys.executable, "setup.py", "-q", "egg_info", "-e", str(tmp_path)]
        subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
        (requires,) = tmp_path.glob("*.egg-info/requires.txt")
        assert ("ros-rclpy" in requires.read_text()) is requested


@pytest.mark.parametrize("name", EXECUTABLES)
def test_without_ros_an_executable_says_so_in_one_line(name: str) -> None:
    absent = "dict.fromkeys(['rclpy', 'builtin_interfaces', 'sensor_msgs', 'nav_msgs', 'std_msgs', 'rosgraph_msgs'])"
    code = f"import sys; sys.modules.update({absent}); from dpm2_ros import executables as e; sys.exit(e.{name}([]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "error: no ROS 2 here: install it and source its setup.bash, see docs/ros2.md\n"


def test_package_xml_agrees_with_setup_py(wheel: zipfile.ZipFile) -> None:
    root = ET.parse(ROOT / "package.xml").getroot()
    metadata = wheel.read(next(name for name in wheel.namelist() if name.endswith("METADATA"))).decode()
    assert f"\nVersion: {root.findtext('version')}\n" in metadata
    assert root.findtext("name") == "dpm2_ros"
    assert root.findtext("export/build_type") == "ament_python"
    # colcon silently treats a package with an invalid address as plain Python
    assert re.fullmatch(r"[\w.+-]+@[\w-]+(\.[\w-]+)*\.[a-zA-Z]{2,}", root.find("maintainer").get("email"))


def test_ros_packages_that_are_imported_are_declared() -> None:
    root = ET.parse(ROOT / "package.xml").getroot()
    declared = {element.text for element in root.findall("exec_depend")}
    imported = set()
    for file in [*(ROOT / "dpm2_ros").glob("*.py"), *(ROOT / "launch").glob("*.py")]:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.split(".")[0])
    ros = {name for name in imported if name.endswith(("_msgs", "_srvs", "_interfaces")) or name in ("rclpy", "launch")}
    assert len(ros) > 8
    assert ros <= declared


def test_the_dds_profile_is_well_formed_and_large_enough_for_a_cloud() -> None:
    root = ET.parse(share_directory() / "config" / "fastdds.xml").getroot()
    space = {"f": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
    assert int(root.findtext(".//f:segment_size", namespaces=space)) >= 16 * 1_920_000  # 16 clouds of 120,000 points
    assert int(root.findtext(".//f:maxMessageSize", namespaces=space)) >= 4_000_000


def test_the_rviz_layout_shows_topics_that_exist() -> None:
    layout = yaml.safe_load((share_directory() / "config" / "dpm2.rviz").read_text())
    shown = {d["Topic"]["Value"] for d in layout["Visualization Manager"]["Displays"] if "Topic" in d}
    code = "".join((ROOT / "dpm2_ros" / name).read_text() for name in ("slam_node.py", "mapping.py"))
    ours = {topic for topic in shown if topic.startswith("/dpm2/")}
    assert {"/dpm2/map", "/dpm2/path", "/dpm2/odom"} <= ours
    assert all(f'"{topic[1:]}"' in code for topic in ours)


def test_tf2_msgs_built_here_talks_to_those_of_ros(domain: int) -> None:
    """DDS compares the type hash; this is the one that ROS 2 Jazzy's own package announces."""
    import rclpy
    from tf2_msgs.msg import TFMessage

    ros_context([], domain)
    node: Node = rclpy.create_node("hash")
    try:
        node.create_publisher(TFMessage, "/tf", 1)
        (info,) = node.get_publishers_info_by_topic("/tf")
        assert str(info.topic_type_hash) == build_tf2_msgs.TYPE_HASH
    finally:
        end_ros(node)


def test_tf2_msgs_without_a_compiler_is_one_line(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-c",
        "from dpm2_ros import build_tf2_msgs as b; b.available = lambda: False; exit(b.main())",
    ]
    done = subprocess.run(
        command, env=ros_environment(99) | {"PATH": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: tf2_msgs cannot be built: no gcc on PATH")
    assert len(done.stderr.splitlines()) == 1
