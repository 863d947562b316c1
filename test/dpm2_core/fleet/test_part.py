# SPDX-License-Identifier: Apache-2.0
"""Parts run once, and again if their input has changed; a failed part is named."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.fleet.part import DONE, Part, Progress, do_part, figures_of, remove_attempts, run_parts

WORK = "part_work:count"
SOURCE = """
import os
import signal
from dpm2_core.errors import UsageError

def die(folder, advance):
    os.kill(os.getpid(), signal.SIGKILL)

def count(folder, advance, start):
    log = folder / "log"
    log.write_text(log.read_text() + "x" if log.exists() else "x")
    for i in range(3):
        advance(i + 1, 3)
    if start < 0:
        raise UsageError("below zero")
    return {"value": start + 1, "times": len(log.read_text()), "process": os.getpid()}
"""
"""A part that counts how often it ran."""


@pytest.fixture(autouse=True)
def _importable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make `part_work` importable, also in other processes."""
    (tmp_path / "part_work.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "part_work", raising=False)


def test_what_is_done_is_not_done_again_unless_its_input_changed(tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    weights.write_text("1")
    parts = [Part("a/0", WORK, {"start": 1}), Part("a/1", WORK, {"start": 2}, [weights])]
    frames: list[tuple[str, int, int]] = []
    told: list[tuple[str, int, int]] = []
    progress = Progress(lambda *now: frames.append(now), lambda *now: told.append(now))
    found = run_parts(parts, tmp_path, progress=progress)
    assert [found[name]["value"] for name in ("a/0", "a/1")] == [2, 3]
    assert told == [("a/0", 1, 2), ("a/1", 2, 2)]
    assert frames[-1] == ("a/1", 3, 3)
    assert found["a/0"]["part"]["peak_memory_mb"] > 0
    assert run_parts(parts, tmp_path) == found
    weights.write_text("2")
    again = run_parts([*parts, Part("a/2", WORK, {"start": 5})], tmp_path)
    assert [again[name]["times"] for name in again] == [1, 2, 1]
    changed = run_parts([Part("a/0", WORK, {"start": 7})], tmp_path)
    assert changed["a/0"]["value"] == 8


def test_what_read_something_else_is_done_again(tmp_path: Path) -> None:
    """An example is a drive that now has more frames; an older record without this information is kept."""
    assert run_parts([Part("a", WORK, {"start": 1}, content="half a drive")], tmp_path)["a"]["times"] == 1
    whole = Part("a", WORK, {"start": 1}, content="the drive")
    assert run_parts([whole], tmp_path)["a"]["times"] == 2
    assert run_parts([whole], tmp_path)["a"]["times"] == 2
    record = json.loads((tmp_path / "a" / DONE).read_text())
    del record["content"]
    (tmp_path / "a" / DONE).write_text(json.dumps(record))
    assert run_parts([replace(whole, content="another")], tmp_path)["a"]["times"] == 2


@pytest.mark.slow
def test_parts_in_processes_of_their_own_give_the_same(tmp_path: Path) -> None:
    """Results are in the requested order; a part that fails is named nevertheless."""
    parts = [Part(str(i), WORK, {"start": i}) for i in range(3)]
    found = run_parts(parts, tmp_path, workers=2)
    assert [figures["value"] for figures in found.values()] == [1, 2, 3]
    assert os.getpid() not in [figures["process"] for figures in found.values()]
    with pytest.raises(UsageError, match=r"^bad: below zero$"):
        run_parts([Part("bad", WORK, {"start": -1}), Part("good", WORK, {"start": 1})], tmp_path, workers=2)


@pytest.mark.slow
def test_a_worker_that_is_killed_is_one_line(tmp_path: Path) -> None:
    """A worker that the kernel kills for lack of memory is an error that says what to do. Previously, it was a
    traceback of concurrent.futures."""
    parts = [Part("dead", "part_work:die", {}), Part("good", WORK, {"start": 1})]
    with pytest.raises(Dpm2Error, match=r"^a worker process was killed, .* fewer --workers$"):
        run_parts(parts, tmp_path, workers=2)
    parts = [Part("next", WORK, {"start": 3}), parts[1]]
    assert [figures["value"] for figures in run_parts(parts, tmp_path, workers=2).values()] == [4, 2]


def test_a_part_that_fails_is_named_and_is_not_done(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^bad: below zero$"):
        run_parts([Part("good", WORK, {"start": 0}), Part("bad", WORK, {"start": -1})], tmp_path)
    assert json.loads((tmp_path / "good" / DONE).read_text())["figures"]["value"] == 1
    assert not (tmp_path / "bad" / DONE).exists()


def test_a_damaged_record_is_made_anew(tmp_path: Path) -> None:
    part = Part("a", WORK, {"start": 1})
    run_parts([part], tmp_path)
    (tmp_path / "a" / DONE).write_text("{")
    assert run_parts([part], tmp_path)["a"]["times"] == 2


def test_a_fresh_part_is_whole_or_not_there(tmp_path: Path) -> None:
    """Its folder appears only when complete; one that was truncated later, or left by a kill, does not count as
    complete."""
    part, out = Part("a", WORK, {"start": 1}, fresh=True), tmp_path / "out"
    with pytest.raises(UsageError, match="below zero"):
        do_part(Part("a", WORK, {"start": -1}, fresh=True), out)
    assert not list(out.iterdir())
    assert do_part(part, out)["value"] == 2
    assert (found := figures_of(part, out)) is not None
    assert found["times"] == 1
    assert figures_of(Part("a", WORK, {"start": 2}, fresh=True), out) is None
    (out / "a" / "log").write_text("")
    assert figures_of(part, out) is None
    assert do_part(part, out)["times"] == 1, "it began with what was there before"
    (out / ".a.0.attempt").mkdir()
    (out / ".ab.0.attempt").mkdir()
    remove_attempts(part, out)
    assert sorted(path.name for path in out.iterdir()) == [".ab.0.attempt", "a"]
