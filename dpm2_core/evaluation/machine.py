# SPDX-License-Identifier: Apache-2.0
"""Checks of what dpm2 uses on a machine and what is missing: each check tests the real thing."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from dpm2_core._version import __version__
from dpm2_core.evaluation.record import package_version

Level = Literal["ok", "note", "warning", "error"]
"""A note: something is missing that may not be needed. A warning: it has noticeable effects. An error: it does not
work."""
DISTRIBUTION = "dpm2_ros"
_PACKAGES = (
    "numpy",
    "scipy",
    "torch",
    "numba",
    "gtsam",
    "safetensors",
    "pydantic",
    "rosbags",
    "opencv-python-headless",
)
_GB, _MB = 1e9, 1e6


@dataclass(frozen=True)
class Finding:
    """One line: what was checked, how it is, what was found, and what to do about it."""

    what: str
    level: Level
    found: str
    advice: str = ""


def check_machine(folder: Path) -> Iterator[Finding]:
    """Every check except the self-test; `folder`: where results will be written."""
    yield from (python(), packages(), extras(), processor(), memory(), gpu())
    yield from (disk(folder), shared_memory(), ros(), dds())


def python() -> Finding:
    """dpm2 and Python."""
    version = ".".join(map(str, sys.version_info[:3]))
    found = f"dpm2 {__version__}, Python {version} in {sys.prefix}"
    if sys.version_info[:2] not in ((3, 11), (3, 12)):
        return Finding("python", "error", found, "dpm2 is made for Python 3.11 and 3.12")
    return Finding("python", "ok", found)


def packages(names: tuple[str, ...] = _PACKAGES) -> Finding:
    """Versions of the packages that everything needs."""
    versions = {name: package_version(name) for name in names}
    found = ", ".join(f"{name} {version or 'missing'}" for name, version in versions.items())
    if not all(versions.values()):
        return Finding("packages", "error", found, f"pip install {DISTRIBUTION}")
    return Finding("packages", "ok", found)


def extras() -> Finding:
    """Which extras are installed."""
    wanted: dict[str, list[str]] = {}
    for line in metadata.requires(DISTRIBUTION) or ():
        extra = re.search(r"""extra == ['"](\w+)['"]""", line)
        name = re.match(r"[\w.-]+", line)
        if extra and name:
            wanted.setdefault(extra[1], []).append(name[0])
    installed = {extra for extra, names in wanted.items() if all(map(package_version, names))}
    missing = sorted(set(wanted) - installed)
    found = f"{', '.join(sorted(installed)) or 'none'}; without {', '.join(missing) or 'none'}"
    return Finding("extras", "ok" if not missing else "note", found)


def processors() -> int:
    """Number of processors that this process may use, by its affinity and the quota of a container."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _read("/sys/fs/cgroup/cpu.max").split()
    if len(quota) == 2 and quota[0].isdecimal():
        cores = max(1, min(cores, int(quota[0]) // int(quota[1])))
    return cores


def processor() -> Finding:
    """Cores that this process may use, and the instructions that make the network faster."""
    cores = processors()
    text = _read("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.+)", text)
    flags = set(re.findall(r"\w+", " ".join(re.findall(r"^(?:flags|Features)\s*: (.+)", text, re.MULTILINE)[:1])))
    bf16 = dict.fromkeys(("avx512_bf16", "amx_bf16", "bf16"), "bf16")  # else float32, network/precision.py
    known = {"avx2": "AVX2", "avx512f": "AVX-512", "amx_tile": "AMX", "asimd": "NEON", **bf16}
    has = list(dict.fromkeys(name for flag, name in known.items() if flag in flags))
    found = f"{model[1] if model else 'unknown'}, {cores} cores, {', '.join(has) or 'no vector instructions known'}"
    if not has:
        return Finding("processor", "warning", found, "without AVX2 or NEON the network is slow")
    if cores < 2:
        return Finding("processor", "warning", found, "odometry and map need a core each")
    return Finding("processor", "ok", found)


def memory(enough: float = 2 * _GB) -> Finding:
    """Memory that is free; `enough` in bytes."""
    match = re.search(r"MemAvailable:\s+(\d+) kB", _read("/proc/meminfo"))
    if match is None:
        return Finding("memory", "note", "unknown: no /proc/meminfo")
    free = 1024.0 * int(match[1])
    limit, used = (_read(f"/sys/fs/cgroup/memory.{name}").strip() for name in ("max", "current"))
    if limit.isdecimal() and used.isdecimal():
        free = min(free, float(limit) - float(used))
    found = f"{free / _GB:.1f} GB free"
    if free < enough:
        return Finding("memory", "warning", found, f"a drive with images needs {enough / _GB:.0f} GB")
    return Finding("memory", "ok", found)


def gpu() -> Finding:
    """A GPU that torch can use."""
    if find_spec("torch") is None:
        return Finding("GPU", "error", "torch is missing")
    import torch

    if torch.cuda.is_available():
        return Finding("GPU", "ok", f"{torch.cuda.get_device_name(0)}, CUDA {torch.version.cuda}")
    if not any(Path("/dev").glob("nvidia[0-9]*")):
        return Finding("GPU", "note", "none", "not needed: the SLAM runs on the processor; training takes longer")
    built = f"CUDA {torch.version.cuda}" if torch.version.cuda else "processors only"
    found = f"present, but torch {torch.__version__}, built for {built}, cannot use it"
    return Finding("GPU", "warning", found, "install a torch whose CUDA fits the driver (nvidia-smi shows both)")


def disk(folder: Path, enough: float = 5 * _GB) -> Finding:
    """Whether files can be written to a folder, and the free space; `enough` in bytes."""
    name = f"disk of {folder.resolve()}"
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 20))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return Finding(name, "error", f"1 MB cannot be written: {error.strerror}", "choose another --out")
    free = shutil.disk_usage(folder).free
    found = f"{free / _GB:.1f} GB free"
    if free < enough:
        return Finding(name, "warning", found, "too little for bags of drives; --folder checks another disk")
    return Finding(name, "ok", found)


def shared_memory(folder: Path = Path("/dev/shm"), enough: float = 64 * _MB) -> Finding:
    """Memory through which DDS and the workers of a training exchange data; `enough` in bytes."""
    if not folder.is_dir():
        return Finding("shared memory", "warning", f"no {folder}", "clouds between nodes are sent over UDP")
    free = shutil.disk_usage(folder).free
    found = f"{free / _MB:.0f} MB free in {folder}"
    if free < enough:
        return Finding("shared memory", "warning", found, "in a container: --shm-size=1g, or --ipc=host")
    return Finding("shared memory", "ok", found)


def ros() -> Finding:
    """ROS 2 in this Python."""
    if find_spec("rclpy") is None:
        where = f"{os.environ['ROS_DISTRO']} is sourced, but not for this Python" if "ROS_DISTRO" in os.environ else ""
        return Finding("ROS 2", "warning", where or "none", "only the ROS nodes need it: docs/ros2.md")
    rclpy = package_version("ros-rclpy") or package_version("rclpy") or "?"
    kind = os.environ.get("ROS_DISTRO") or f"wheels, rclpy {rclpy}"
    if find_spec("tf2_msgs") is None:
        return Finding("ROS 2", "warning", f"{kind}, without tf2_msgs", "no /tf: python -m dpm2_ros.build_tf2_msgs")
    return Finding("ROS 2", "ok", kind)


def dds(timeout: float = 15.0) -> Finding:
    """Send a cloud from a node to itself, in its own process; `timeout` in s."""
    if find_spec("rclpy") is None:
        return Finding("DDS", "note", "not tested without ROS 2")
    names = ("RMW_IMPLEMENTATION", "ROS_DOMAIN_ID", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE")
    chosen = "".join(f", {name}={os.environ[name]}" for name in names if name in os.environ)
    try:
        command = [sys.executable, "-m", "dpm2_ros.round_trip"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=True)
        answer = json.loads(done.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        return Finding("DDS", "warning", f"no cloud came back within {timeout:g} s{chosen}", "docs/ros2.md, QoS")
    except (subprocess.CalledProcessError, ValueError, IndexError) as error:
        last = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
        return Finding("DDS", "warning", f"{last[-1] if last else error}{chosen}", "docs/ros2.md")
    buffer = _read("/proc/sys/net/core/rmem_max").strip()
    found = f"{answer['rmw']}, a cloud of 2 MB in {answer['ms']:.0f} ms{chosen}; rmem_max {buffer or 'unknown'}"
    return Finding("DDS", "ok", found)


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
