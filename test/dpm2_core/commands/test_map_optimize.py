# SPDX-License-Identifier: Apache-2.0
"""`dpm2 map optimize` from file to file, and its errors in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from benchmarks.pose_graph import are_right, made_drive
from dpm2_core.slam.graph.calibrated import scaled
from dpm2_core.slam.graph.g2o import G2o, read_g2o, write_g2o

from ...helpers.command import dpm2, refused, succeeded


def test_wrong_loops_are_named_and_left_out(tmp_path: Path) -> None:
    truth, graph = made_drive(10, count=1500, right=20)
    right = are_right(truth, graph)
    assert right.sum() == 20  # the wrong ones are really wrong
    path, out, info = tmp_path / "in.g2o", tmp_path / "out.g2o", tmp_path / "out.json"
    write_g2o(path, G2o(graph, np.arange(1500), planar=False))
    assert dpm2("map", "optimize", path, "--out", out, "--json", info).returncode == 0
    assert out.read_text().count("VERTEX_SE3:QUAT ") == 1500
    result = read_g2o(out)
    assert {tuple(e) for e in result.graph.ends.tolist()} == {tuple(e) for e in graph.ends[right].tolist()}
    record = json.loads(info.read_text())
    assert (record["kept"], record["rejected"]) == (20, 10)
    assert [check["kept"] for check in record["verdicts"]] == right.tolist()
    assert record["chi2_after"] < 1e-2 * record["chi2_before"]


def test_covariances_that_do_not_fit_are_said(tmp_path: Path) -> None:
    """If the covariances do not match the residuals, a warning is given, and they are scaled. Previously, with
    information of identity, as many programs write it, all 13 wrong loops of a graph were kept and the map was bent,
    without a message."""
    _, graph = made_drive(15, count=1500, right=20)
    path, out, info = tmp_path / "in.g2o", tmp_path / "out.g2o", tmp_path / "out.json"
    write_g2o(path, G2o(scaled(graph, 1e4), np.arange(1500), planar=False))
    done = dpm2("map", "optimize", "-q", path, "--out", out, "--json", info)
    record = json.loads(info.read_text())
    assert (record["kept"], record["rejected"], record["trajectories"]) == (20, 15, 1)
    assert [warning for warning in record["warnings"] if "times too large" in warning] == record["warnings"]
    assert done.stderr.count("\n") == 1
    assert "in.g2o: the covariances are" in done.stderr
    assert 0.2e-4 < record["chi2_per_dof"] < 5e-4
    write_g2o(path, G2o(graph, np.arange(1500), planar=False))
    done = dpm2("map", "optimize", path, "--out", out, "--json", "-")
    assert (json.loads(done.stdout)["warnings"], done.stderr) == ([], "")


def test_what_is_no_drive_is_said(tmp_path: Path) -> None:
    path = tmp_path / "star.g2o"
    path.write_text("".join(f"EDGE_SE2 0 {k} 1 0 0 1 0 0 1 0 1\n" for k in range(1, 12)))
    done = succeeded("map", "optimize", path, "--out", tmp_path / "out.g2o")
    assert "11 trajectories: 10 of 12 vertices have no edge to the one before" in done.stderr


def test_a_few_vertices_that_are_not_tied_are_counted(tmp_path: Path) -> None:
    """Three drives that loops connected to one map."""
    path = tmp_path / "drives.g2o"
    edges = [(k, k + 1) for k in range(11) if k not in (3, 7)] + [(0, 4), (4, 8)]
    path.write_text("".join(f"EDGE_SE2 {a} {b} 1 0 0 1 0 0 1 0 1\n" for a, b in edges))
    done = dpm2("map", "optimize", path, "--out", tmp_path / "out.g2o")
    assert "3 trajectories: 2 of 12 vertices have no edge to the one before" in done.stderr


def test_a_short_chain_is_one_drive(tmp_path: Path) -> None:
    path = tmp_path / "chain.g2o"
    path.write_text("".join(f"EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1\n" for k in range(3)))
    assert dpm2("map", "optimize", path, "--out", tmp_path / "out.g2o").stderr == ""


def test_the_graph_itself_is_not_overwritten(tmp_path: Path) -> None:
    path, link = tmp_path / "in.g2o", tmp_path / "link.g2o"
    path.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_XY 0 1 2 3\n")
    link.symlink_to(path)
    for out in (path, link):
        done = dpm2("map", "optimize", path, "--out", out)
        assert (done.returncode, "is the input graph" in done.stderr) == (2, True)
    assert "EDGE_XY" in path.read_text()


def test_bad_input_is_one_line_and_leaves_no_file(tmp_path: Path) -> None:
    out = tmp_path / "out.g2o"
    (tmp_path / "two.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 7 8 1 0 0 1 0 0 1 0 1\n")
    for path, message in ((tmp_path / "none.g2o", "No such file"), (tmp_path / "two.g2o", "no edge connects")):
        error = refused("map", "optimize", path, "--out", out)
        assert message in error
        assert str(path) in error
    assert not out.exists()
