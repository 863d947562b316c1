# SPDX-License-Identifier: Apache-2.0
"""`dpm2 report` of experiments: their tables, with or without runs, from a parent folder or from their own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dpm2_core.data.trajectory import write_tum
from dpm2_core.experiments.table import ResultTable

from ...helpers.command import Done, dpm2


def experiment(folder: Path, name: str, value: float) -> Path:
    """The output of an experiment: a table with that value, and its page."""
    table = ResultTable(f"Table of <{name}>", ["06"], {"t": ".3f"})
    table.add("ours", {"06": {"t": value}})
    folder.mkdir(parents=True)
    (folder / f"{name}.json").write_text(json.dumps({"tables": [table.record()]}))
    (folder / f"{name}.html").write_text("")
    return folder


def report(out: Path, *folders: Path) -> tuple[Done, str]:
    """The finished command, and the page."""
    done = dpm2("report", *folders, "--out", out)
    return done, out.read_text() if done.returncode == 0 else ""


def test_an_experiment_without_a_run_has_its_tables(tmp_path: Path) -> None:
    """A folder of an experiment without runs is accepted, as of a task that leaves only figures; previously, it was
    rejected."""
    done, page = report(tmp_path / "r.html", experiment(tmp_path / "ground", "gndnet", 0.125))
    assert done.returncode == 0, done.stderr
    assert "<h2>Table of &lt;gndnet&gt;</h2>" in page
    assert "0.125" in page
    (tmp_path / "empty").mkdir()
    done, _ = report(tmp_path / "other.html", tmp_path / "ground", tmp_path / "empty")
    assert (done.returncode, f"{tmp_path / 'empty'}: no run in or below it" in done.stderr) == (2, True)


def test_experiments_below_a_folder_have_their_tables_by_its_name(tmp_path: Path) -> None:
    """Both runs and tables of the experiments are on the page; previously, the tables were not."""
    for number, name in enumerate(("first", "second")):
        run = experiment(tmp_path / "out" / name, "kitti", number + 0.25) / "ours" / "06"
        run.mkdir(parents=True)
        write_tum(run / "trajectory.tum", [1, 2], np.stack([np.eye(4)] * 2))
    (tmp_path / "out" / "notes").mkdir()
    (tmp_path / "out" / "notes" / "kitti.json").write_text("{}")  # written by another program
    done, page = report(tmp_path / "r.html", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for name, value in (("first", "0.250"), ("second", "1.250")):
        assert f"<h2>{name}: Table of &lt;kitti&gt;</h2>" in page
        assert value in page
    assert done.stderr.endswith(f": 2 runs, {len(page) / 1e3:.0f} kB\n")  # it was 0.0 MB
    (tmp_path / "out" / "second" / "kitti.json").write_text("{")
    done, _ = report(tmp_path / "r.html", tmp_path / "out")
    assert (done.returncode, "second/kitti.json: not a record of an experiment" in done.stderr) == (2, True)
