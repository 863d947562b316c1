# SPDX-License-Identifier: Apache-2.0
"""A record names the commit of the program, never that of a user's own repository."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from dpm2_core.evaluation import record


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A user's, with one commit."""
    for command in (
        ("init", "-q"),
        ("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "--allow-empty", "-mx"),
    ):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    return tmp_path


def test_the_commit_is_that_of_the_programs_own_repository(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed into a virtual environment below a user's repository the program has no commit."""
    monkeypatch.setattr(record, "REPOSITORY", repository)
    commit = record.git_commit()
    assert commit is not None
    assert len(commit) == 12
    installed = repository / "venv" / "site-packages"
    installed.mkdir(parents=True)
    monkeypatch.setattr(record, "REPOSITORY", installed)
    assert record.git_commit() is None
