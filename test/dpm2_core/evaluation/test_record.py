# SPDX-License-Identifier: Apache-2.0
"""A record contains the program's commit, never that of a user's own repository."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from dpm2_core.evaluation import record


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A user's repository with one commit."""
    for command in (
        ("init", "-q"),
        ("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "--allow-empty", "-mx"),
    ):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    return tmp_path


def test_the_commit_is_that_of_the_programs_own_repository(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed into a virtual environment below a user's repository, the program has no commit."""
    monkeypatch.setattr(record, "REPOSITORY", repository)
    commit = record.git_commit()
    assert commit is not None
    assert len(commit) == 12
    installed = repository / "venv" / "site-packages"
    installed.mkdir(parents=True)
    monkeypatch.setattr(record, "REPOSITORY", installed)
    assert record.git_commit() is None


@pytest.mark.parametrize(
    ("file", "marked"),
    [("benchmarks/map.py", True), ("dpm2_core/new.py", True), ("benchmarks/map.json", False), ("out/a.py", False)],
)
def test_a_changed_benchmark_and_a_new_module_are_no_clean_commit(
    repository: Path, monkeypatch: pytest.MonkeyPatch, file: str, marked: bool
) -> None:
    """Such a commit is marked. Previously, only tracked files of dpm2_core counted, although a benchmark defines what a
    success is."""
    monkeypatch.setattr(record, "REPOSITORY", repository)
    path = repository / file
    path.parent.mkdir()
    path.write_text("LATERAL = 9\n")
    assert (record.git_commit() or "").endswith("+") == marked
