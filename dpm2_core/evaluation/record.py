# SPDX-License-Identifier: Apache-2.0
"""Results as JSON, with what is needed to assess and repeat them: command, commit, machine, versions."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dpm2_core.files import atomic_write, json_text

REPOSITORY = Path(__file__).resolve().parents[2]
MEASURED = ("dpm2_core", "benchmarks/*.py")
"""The parts of the repository that a record is about."""
_PACKAGES = ("numpy", "scipy", "numba", "small_gicp", "gtsam", "torch", "kiss-icp")


def write_record(path: Path, results: dict[str, Any], program: str = "dpm2", threads: int = 2) -> None:
    """Write results as JSON, with everything needed to assess and repeat them; the file has the benchmark's name.

    Raises:
        Dpm2Error: the file could not be written.
    """
    record = {
        "benchmark": path.stem,
        "command": shlex.join([*program.split(), *sys.argv[1:]]),
        "commit": git_commit(),
        "machine": {"processor": _processor(), "cpus": os.cpu_count(), "threads": threads},
        "versions": {"python": platform.python_version(), **{p: package_version(p) for p in _PACKAGES}},
        **results,
    }
    with atomic_write(path) as file:
        file.write(json_text(record, indent=1))


def git_commit() -> str | None:
    """The commit that was measured, with "+" if the program or a benchmark differs from it, new files included.

    None outside its own repository.
    """
    try:
        if _git("rev-parse", "--show-prefix"):
            return None  # installed below a repository of something else
        commit = _git("rev-parse", "--short=12", "HEAD")
        changed = _git("status", "--porcelain", "--untracked-files=all", "--", *MEASURED)
        return commit + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def package_version(package: str) -> str | None:
    """Version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    """Model of the processor, as Linux names it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
