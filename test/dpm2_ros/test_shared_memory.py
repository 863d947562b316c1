# SPDX-License-Identifier: Apache-2.0
"""The next process frees the shared memory of a killed process; that of running processes is kept."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dpm2_ros.shared_memory import free_shared_memory
from tools.replay import ros_environment

NODE = """
import sys, time
from dpm2_ros.runtime import ros_context
ros_context([])
import rclpy
node = rclpy.create_node("listener")
print("up", flush=True)
sys.stdin.read()
"""


def _up(domain: int) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", NODE], env=ros_environment(domain), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    assert process.stdout is not None
    while "up" not in process.stdout.readline():
        assert process.poll() is None
    return process


def _segments(process: subprocess.Popen[str]) -> list[Path]:
    """Segments whose lock files a process has locked: of our profile's transport, and a small one of rmw's."""
    rows = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
    held = {int(row[5].rpartition(":")[2]) for row in rows if row[1] == "FLOCK" and row[4] == str(process.pid)}
    locks = [path for path in Path("/dev/shm").glob("fastrtps_*_el") if "port" not in path.name]
    return [path.with_name(path.name.removesuffix("_el")) for path in locks if path.stat().st_ino in held]


def _age(segment: Path, seconds: float) -> None:
    then = time.time() - seconds
    os.utime(segment.with_name(f"{segment.name}_el"), (then, then))


def test_the_next_process_frees_what_a_killed_one_has_left(domain: int) -> None:
    processes = []
    try:
        for _ in range(3):
            processes.append(_up(domain))
        living, killed, fresh = (_segments(process) for process in processes)
        assert sum(segment.stat().st_size for segment in killed) > 30e6
        for process in processes[1:]:
            process.kill()
            process.wait()
        for segment in (*living, *killed):
            _age(segment, 100)
        processes.append(_up(domain))
        assert not any(segment.exists() for segment in killed)
        assert not any(segment.with_name(f"{segment.name}_el").exists() for segment in killed)
        # The running process has its locks; a process that has just started may not have taken its locks yet.
        assert all(segment.is_file() for segment in (*living, *fresh))
    finally:
        for process in processes:
            process.kill()


def test_other_files_and_what_cannot_be_removed_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["fastrtps_port7411", "other", "fastrtps_0123456789abcdef", "fastrtps_fedcba9876543210"]
    for name in names:
        (tmp_path / name).write_bytes(b"12345")
        lock = tmp_path / f"{name}_el"
        lock.touch()
        os.utime(lock, (0, 0))
    unlink: Callable[..., None] = Path.unlink

    def refused(path: Path, missing_ok: bool = False) -> None:
        if path.name.startswith("fastrtps_fedc"):
            raise PermissionError(path)
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refused)
    free_shared_memory(tmp_path)
    left = sorted(path.name for path in tmp_path.iterdir() if not path.name.endswith("_el"))
    assert left == sorted(set(names) - {names[2]})
    free_shared_memory(tmp_path / "nowhere")
