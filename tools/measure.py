# SPDX-License-Identifier: Apache-2.0
"""Repeats the measurements of records that depend on the weights (`make measure`).

An interrupted run can be continued: a record is current if the code has not changed since the commit in the record.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import run_command
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.record import MEASURED, REPOSITORY, git_commit

RECORDS = REPOSITORY / "benchmarks"
COMMANDS: dict[str, Sequence[str]] = {
    "geometric": (), "neural": (), "hard": (), "paper": (), "gaps": (),
    "covariance": ("--threads", "1"), "tilt": (), "sensor": (), "relocalise": ("--pairs", "200"),
    "pose-graph": (), "loop-cost": (), "diffslam": (), "map": (), "roads": (), "fleet": (), "indoor": (),
    "motion": (), "beside": (), "imu": ("--threads", "1"),
    "traffic": ("--threads", "1", "--repetitions", "3"), "finetune": (),
}  # fmt: skip
"""Benchmarks and their options, fast ones first."""
TARGETS = {name: f"bench-{name}" for name in ("livox", "kitti", "robustness", "memory")}
"""Records that are made by a target of the Makefile."""


def remaining(names: Sequence[str]) -> list[str]:
    """The records that are missing or were measured with other code.

    Raises:
        UsageError: no such record.
    """
    known = [*COMMANDS, *TARGETS]
    for name in names:
        if name not in known:
            raise UsageError(f"{name}: no such record; choose from {', '.join(known)}")
    return [name for name in names or known if not _is_current(measured_at(RECORDS / f"{name}.json"))]


def measured_at(path: Path) -> str | None:
    """The commit named in a record; None if there is no readable record."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    commit = record.get("commit") if isinstance(record, dict) else None
    return commit if isinstance(commit, str) else None


def _is_current(commit: str | None) -> bool:
    """Whether the measured code is the same as at a commit."""
    command = ["git", "diff", "--quiet", f"{commit}", "HEAD", "--", *MEASURED]
    return commit is not None and not subprocess.run(command, cwd=REPOSITORY, capture_output=True).returncode


def measure(names: Annotated[list[str] | None, typer.Argument(help="Names of records. Default: all.")] = None) -> None:
    """Measure what is missing, one benchmark after the other."""
    commit = git_commit()
    if commit is None or commit.endswith("+"):
        raise UsageError("a record names the commit that was measured: commit your changes first")
    for name in remaining(names or ()):
        print(f"{name}: at {measured_at(RECORDS / f'{name}.json') or 'no commit'}, measuring again", flush=True)
        bench = [sys.executable, "-m", "dpm2_core.cli", "bench", name, *COMMANDS.get(name, ())]
        command = ["make", TARGETS[name]] if name in TARGETS else bench
        if subprocess.run(command, cwd=REPOSITORY, check=False).returncode:
            raise Dpm2Error(f"{name}: the benchmark failed; the records that were measured before it are kept")


if __name__ == "__main__":
    sys.exit(run_command(measure))
