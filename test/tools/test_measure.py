# SPDX-License-Identifier: Apache-2.0
"""Records that must be measured again: those of other code, and those that are missing or unreadable."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import BENCHES
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.record import REPOSITORY, git_commit
from tools import measure


def test_every_record_is_a_benchmark_with_options_that_it_takes() -> None:
    for name, options in measure.COMMANDS.items():
        taken = set(BENCHES[name].split())
        assert {option.removeprefix("--") for option in options if option.startswith("--")} <= taken


def test_other_records_are_made_by_targets_of_the_makefile() -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    for name, target in measure.TARGETS.items():
        assert f"\n{target}:" in makefile
        assert f"benchmarks/{name}.json" in makefile


def test_records_of_this_code_are_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commit = git_commit()
    if commit is None:
        pytest.skip("no git repository")
    monkeypatch.setattr(measure, "RECORDS", tmp_path)
    texts = {
        "hard": f'{{"commit": "{commit.rstrip("+")}"}}',
        "gaps": f'{{"commit": "{commit.rstrip("+")}+"}}',
        "tilt": "[",
        "neural": '{"commit": 5}',
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.json").write_text(text)
    assert measure.remaining([*texts, "paper"]) == ["gaps", "tilt", "neural", "paper"]
    assert "hard" not in measure.remaining([])
    with pytest.raises(UsageError, match="harder: no such record; choose from geometric"):
        measure.remaining(["harder"])


def test_a_changed_checkout_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "git_commit", lambda: "abc+")
    with pytest.raises(UsageError, match="commit your changes"):
        measure.measure()
