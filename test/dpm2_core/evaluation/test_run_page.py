# SPDX-License-Identifier: Apache-2.0
"""The report: its content, and that a real browser shows it without an error and without the network."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.trajectory import read_trajectory, write_tum
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Edge, Registration
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.evaluation.run_folder import write_frames, write_loops, write_truth
from dpm2_core.evaluation.run_page import find_runs, runs_page
from dpm2_core.geometry import se3
from dpm2_core.tables import FigureTable

from ...helpers.command import dpm2

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
EVIL = "</script><script>fetch('http://example.org')</script>"


def write_run(folder: Path, frames: int, scale: float = 1.0) -> Path:
    """A drive in a circle whose estimate is the scaled and rotated truth, with two loops, of which one was rejected."""
    folder.mkdir(parents=True)
    angle = np.linspace(0, 6, frames)
    truth = se3.exp(angle[:, None] * np.array([0, 0, 1.0, 200, 0, 0]))
    est = truth.copy()
    est[:, :3, 3] *= scale
    est = se3.exp([0, 0, 0.7, 30, 40, 1]) @ est
    stamps = [(i + 1) * 10**8 for i in range(frames)]
    write_tum(folder / "trajectory.tum", stamps, est)
    write_truth(folder / "ground_truth.tum", stamps, truth)
    states = ["initialising"] + ["tracking"] * (frames - 2) + ["lost"]
    keys = [(i, s, state, "geometric") for i, (s, state) in enumerate(zip(stamps, states, strict=True))]
    times = {"register": [0.02] * frames, "map": [0.001] * frames}
    write_frames(folder / "frames.csv", keys, times)
    bad = Registration(np.eye(4), np.eye(6), 0.1, np.inf, "points", False, EVIL)
    loops = [Edge("loop", 0, frames - 1, Registration(np.eye(4), np.eye(6))), Edge("loop", 0, frames // 2, bad)]
    write_loops(folder / "loops.csv", loops, est)
    metrics = evaluate(truth, est, (20.0, 50.0)).model_dump()
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "timing.json").write_text(json.dumps({"fps": 47.6}))
    return folder


def data_of(text: str) -> list[dict[str, object]]:
    """The data that the script of a page reads."""
    (held,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    found: list[dict[str, object]] = json.loads(held)
    return found


def test_runs_of_one_drive_are_drawn_together_in_the_frame_of_its_truth(tmp_path: Path) -> None:
    """Another drive has its own group; the text of a file is escaped."""
    for name, frames, scale in (("ours", 120, 1.0), ("theirs", 120, 1.02), ("another", 60, 1.0)):
        write_run(tmp_path / name, frames, scale)
    runs = find_runs([tmp_path])
    assert [name for name, _ in runs] == ["another", "ours", "theirs"]
    table = FigureTable("T", names=["a"])
    table.add_row(EVIL)
    text = runs_page("A report", runs, [table])
    groups = data_of(text)
    assert [[run["name"] for run in group["runs"]] for group in groups] in (
        [["another"], ["ours", "theirs"]], [["ours", "theirs"], ["another"]]
    )  # fmt: skip
    both = next(group for group in groups if len(group["runs"]) == 2)
    np.testing.assert_allclose(both["runs"][0]["way"], both["truth"], atol=0.02)
    assert [loop[4] for loop in both["runs"][0]["loops"]] == [True, False]
    assert both["runs"][0]["states"] == [["initialising", 1], ["tracking", 118], ["lost", 1]]
    assert both["runs"][0]["stages"] == {"register": 20.0, "map": 1.0}
    assert [row[0] for row in both["runs"][1]["byLength"]] == [20.0, 50.0]
    assert EVIL not in text
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "").replace("http://example.org", "")


def test_errors_of_other_segment_lengths_have_columns_of_their_own(tmp_path: Path) -> None:
    """Errors over 20 and 50 m have a column of their own. Previously, they were in the column of errors over 100 to 800
    m, and looked twice as large."""
    short, official = (write_run(tmp_path / name, 240, 1.02) for name in ("short", "official"))
    truth, est = (read_trajectory(official / f"{name}.tum").poses for name in ("ground_truth", "trajectory"))
    whole = evaluate(truth, est)
    (official / "metrics.json").write_text(json.dumps(whole.model_dump()))
    known = json.loads((short / "metrics.json").read_text())
    text = runs_page("A report", find_runs([tmp_path]))
    headings, *rows = (re.findall("<t[hd]>(.*?)</t[hd]>", row) for row in re.findall("<tr>.*?</tr>", text))
    table = {row[0]: dict(zip(headings, row, strict=True)) for row in rows}
    here, other = "t_err %", "t_err % of 20, 50 m"
    assert (table["official"][here], table["official"][other]) == (f"{whole.t_err_percent:.3f}", "-")
    assert (table["short"][here], table["short"][other]) == ("-", f"{known['t_err_percent']:.3f}")
    (together,) = data_of(text)
    assert {run["name"]: run["segments"] for run in together["runs"]} == {"official": "", "short": " of 20, 50 m"}


@pytest.mark.parametrize("known", [False, True])
def test_a_run_without_a_pose_is_on_the_page(tmp_path: Path, known: bool) -> None:
    """A localization without a result leaves a run without poses. Previously, it prevented the page for all other
    runs."""
    write_run(tmp_path / "found", 5)
    (tmp_path / "none").mkdir()
    write_tum(tmp_path / "none" / "trajectory.tum", [], np.zeros((0, 4, 4)))
    if known:
        shutil.copy(tmp_path / "found" / "ground_truth.tum", tmp_path / "none")
    text = runs_page("A report", find_runs([tmp_path]))
    assert "<td>none</td><td>0</td>" in text
    ways = {run["name"]: len(run["way"]) for group in data_of(text) for run in group["runs"]}
    assert ways == {"found": 10, "none": 0}


@pytest.mark.slow
def test_a_whole_kitti_sequence_of_four_methods_is_below_five_megabytes(tmp_path: Path) -> None:
    runs = [(str(i), write_run(tmp_path / str(i), 4541, 1 + i / 100)) for i in range(4)]
    assert len(runs_page("08", runs)) < 5_000_000


def test_runs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """A baseline and a change over the same sequences have distinct names; a run that is given twice is listed once."""
    runs = [write_run(tmp_path / which / name, 5) for which in ("base", "new") for name in ("04", "05")]
    for given in ([tmp_path / "base", tmp_path / "new"], [*runs, tmp_path / "new"]):
        found = find_runs(given)
        assert [name for name, _ in found] == ["base/04", "base/05", "new/04", "new/05"]
        assert [path for _, path in found] == runs
    assert [name for name, _ in find_runs([tmp_path / "base"])] == ["04", "05"]


def test_no_folder_and_no_run_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        find_runs([tmp_path / "none"])
    done = dpm2("report", tmp_path, "--out", tmp_path / "r.html")
    assert done.returncode == 2
    assert "no run in or below it" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH")
def test_a_real_browser_shows_it(tmp_path: Path) -> None:
    """No error in the console, nothing fetched; the wheel zooms, a drag moves, rejected loops can be shown."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    write_run(tmp_path / "runs" / "ours", 300)
    write_run(tmp_path / "runs" / "theirs", 300, 1.05)
    (tmp_path / "runs" / "alone").mkdir()
    write_tum(tmp_path / "runs" / "alone" / "trajectory.tum", [1, 2], np.stack([np.eye(4)] * 2))
    out = tmp_path / "report.html"
    done = dpm2("report", tmp_path / "runs", "--out", out)
    assert done.returncode == 0, done.stderr
    messages: list[str] = []
    requests: list[str] = []
    with api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        tab = browser.new_page(viewport={"width": 1100, "height": 800})
        tab.on("console", lambda message: messages.append(f"{message.type}: {message.text}"))
        tab.on("pageerror", lambda error: messages.append(str(error)))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(out.as_uri())
        assert tab.locator("section").count() == 2
        together = tab.locator("section", has=tab.locator("svg.stages"))
        assert together.locator("svg.chart").count() == 5
        assert together.locator("svg.states rect").count() == 6
        drawn = together.locator("svg.map")
        assert drawn.locator("path.accepted").count() == 2
        assert not drawn.locator("path.rejected").first.is_visible()
        together.get_by_label("loops rejected").check()
        assert drawn.locator("path.rejected").first.is_visible()
        whole = drawn.get_attribute("viewBox")
        drawn.scroll_into_view_if_needed()
        drawn.hover()
        tab.mouse.wheel(0, -400)
        zoomed = drawn.get_attribute("viewBox")
        assert float(zoomed.split()[2]) < 0.7 * float(whole.split()[2])
        tab.mouse.down()
        tab.mouse.move(600, 300)
        tab.mouse.up()
        assert drawn.get_attribute("viewBox") not in (whole, zoomed)
        together.get_by_role("button", name="Whole").click()
        assert drawn.get_attribute("viewBox") == whole
        browser.close()
    assert messages == []
    assert requests == [out.as_uri()]
