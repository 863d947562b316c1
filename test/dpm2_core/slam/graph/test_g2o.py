# SPDX-License-Identifier: Apache-2.0
"""g2o files: they are read back to the last digit, and errors are reported with the line number."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.g2o import read_g2o, require_connected, write_g2o

I3 = "1 0 0 1 0 1"
I6 = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


def file(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("planar", [True, False])
def test_round_trip_at_full_precision(tmp_path: Path, planar: bool) -> None:
    rng = np.random.default_rng(0)
    size, tag = (3, "SE2") if planar else (6, "SE3:QUAT")
    T = se3.exp(rng.normal(size=(4, 6)) * ([0, 0, 1, 9, 9, 0] if planar else [1, 1, 1, 9, 9, 9]))
    lines = ["# a comment", "FIX 7"]
    for n, (a, b) in enumerate([(5, 7), (7, 8), (8, 2**60 + 1), (5, 8)]):
        A = rng.normal(size=(size, size))
        upper = (A @ A.T + np.eye(size))[np.triu_indices(size)]
        yaw = np.arctan2(T[n, 1, 0], T[n, 0, 0])
        pose = (*T[n, :2, 3], yaw) if planar else (*T[n, :3, 3], *Rotation.from_matrix(T[n, :3, :3]).as_quat())
        lines.append(f"EDGE_{tag} {a} {b} " + " ".join(f"{x:.17g}" for x in (*pose, *upper)))
    first = read_g2o(file(tmp_path, *lines))
    assert first.planar is planar
    np.testing.assert_array_equal(first.ids, [5, 7, 8, 2**60 + 1])  # more than a float64 can represent
    np.testing.assert_allclose(first.graph.steps[1:], T[:3], atol=1e-14)
    np.testing.assert_allclose(first.graph.poses[3], T[0] @ T[1] @ T[2], atol=1e-13)  # integrated from the odometry
    write_g2o(tmp_path / "out.g2o", first)
    assert (tmp_path / "out.g2o").read_text().count(f"VERTEX_{tag} ") == 4
    second = read_g2o(tmp_path / "out.g2o")
    for name in ("poses", "steps", "T_from_to", "step_covariances", "covariances", "ends", "fixed"):
        # A pose is converted through a quaternion or an angle, a covariance through an inverse: the last digits are
        # rounded.
        np.testing.assert_allclose(getattr(second.graph, name), getattr(first.graph, name), rtol=1e-12, atol=1e-13)


def test_an_edge_backwards_along_the_chain_is_odometry(tmp_path: Path) -> None:
    result = read_g2o(file(tmp_path, f"EDGE_SE2 1 0 -2 0 0 {I3}", f"EDGE_SE2 1 2 2 0 0 {I3}")).graph
    assert len(result.ends) == 0
    np.testing.assert_allclose(result.poses[:, 0, 3], [0, 2, 4])
    # A rotation error of 1 rad at one end of a 2 m edge is a sideways error of 2 m in the frame of the other end.
    np.testing.assert_allclose(result.step_covariances[1][4, 4], 1 + 2**2)


@pytest.mark.parametrize("vertices", [True, False])
def test_ids_that_do_not_follow_the_drive(tmp_path: Path, vertices: bool) -> None:
    """Previously, each node was a trajectory of its own. The odometry edges counted as loops, and some right ones were
    rejected."""
    ids = np.random.default_rng(0).permutation(30).tolist()
    lines = [f"VERTEX_SE2 {id} {k} 0 0" for k, id in enumerate(ids)] if vertices else []
    lines += [f"EDGE_SE2 {a} {b} 1 0 0 {I3}" for a, b in pairwise(ids)]
    lines += [f"EDGE_SE2 {ids[3]} {ids[20]} 17 0 0 {I3}", f"FIX {ids[5]} {ids[2]}"]
    result = read_g2o(file(tmp_path, *lines))
    assert result.ids.tolist() == ids
    assert result.graph.chained.tolist() == [False] + [True] * 29
    np.testing.assert_array_equal(result.graph.ends, [[3, 20]])
    np.testing.assert_array_equal(result.graph.fixed, [2, 5])
    np.testing.assert_allclose(result.graph.poses[:, 0, 3], np.arange(30), atol=1e-12)


def test_edges_in_no_order_are_not_taken_for_a_drive(tmp_path: Path) -> None:
    """In order of appearance the two vertices of every edge are consecutive, also those of a loop. It would then count
    as odometry."""
    edges = [(a, a + 1) for a in range(0, 40, 2)] + [(a, (a + 20) % 40) for a in range(20)]
    rows = [edges[k] for k in np.random.default_rng(0).permutation(len(edges))]
    result = read_g2o(file(tmp_path, *(f"EDGE_SE2 {a} {b} 1 0 0 {I3}" for a, b in rows)))
    assert result.ids.tolist() == list(range(40))
    assert result.graph.chained.sum() == 20


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["EDGE_SE2 0 1 1 0 0 1 0 0 1 0"], r"graph.g2o:1: EDGE_SE2 with 10 numbers, want 11"),
        ([f"EDGE_SE2 0 1 1 nan 0 {I3}"], r"graph.g2o:1: a number that is not finite"),
        ([f"EDGE_SE2 0 1 1 x 0 {I3}"], r"graph.g2o:1: not a number"),
        ([f"EDGE_SE2 0 1 1 -1e300 0 {I3}"], r"graph.g2o:1: farther than 1000000 km"),
        ([f"EDGE_SE3:QUAT 0 1 1 0 1e10 0 0 0 1 {I6}"], r"graph.g2o:1: farther than 1000000 km"),
        (["", "EDGE_SE2 0 1 1 0 0 1 0 0 0 0 1"], r"graph.g2o:2: information matrix not positive definite"),
        (["EDGE_SE2 0 1 1 0 0 1 0 0 -1e9 0 1"], r"graph.g2o:1: information matrix not .* least value -1e\+09"),
        (["EDGE_SE2 0 1 1 0 0 1 1e-6 0 1e-12 0 1"], r"graph.g2o:1: information matrix not positive definite"),
        ([f"EDGE_SE2 0 0 1 0 0 {I3}"], r"graph.g2o:1: edge from vertex 0 to itself"),
        ([f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 2 {I6}"], r"graph.g2o:1: the quaternion is not of unit length"),
        (["VERTEX_SE2 0 0 0 0", f"EDGE_SE2 0 1 1 0 0 {I3}"], r"graph.g2o:2: edge of vertex 1, which has no VERTEX"),
        (["VERTEX_SE2 0 0 0 0"] * 2 + [f"EDGE_SE2 0 1 1 0 0 {I3}"], r"graph.g2o:2: vertex 0 is defined again"),
        ([f"EDGE_SE2 0 1 1 0 0 {I3}", f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {I6}"], "SE2 and SE3 lines in one graph"),
        ([f"EDGE_SE2 0 1 1 0 0 {I3}", "FIX 9"], "FIX 9: no such vertex"),
        (["EDGE_XY 0 1 2 3"], "no EDGE_SE2 or EDGE_SE3:QUAT line"),
        ([f"EDGE_SE2 0 {2**70} 1 0 0 {I3}"], r"graph.g2o:1: vertex 11805916"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read_g2o(file(tmp_path, *lines))


def test_a_byte_order_mark_hides_no_line(tmp_path: Path) -> None:
    path = file(tmp_path, f"EDGE_SE2 0 1 1 0 0 {I3}", f"EDGE_SE2 1 2 1 0 0 {I3}")
    path.write_text(path.read_text(), encoding="utf-8-sig")
    read = read_g2o(path)
    assert (len(read.graph), read.ignored) == (3, {})


def test_a_missing_and_a_binary_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        read_g2o(tmp_path / "none.g2o")
    (tmp_path / "b.g2o").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="no text file"):
        read_g2o(tmp_path / "b.g2o")


def test_a_part_that_no_edge_reaches_is_named(tmp_path: Path) -> None:
    path = file(tmp_path, *(f"EDGE_SE2 {a} {a + 1} 1 0 0 {I3}" for a in (0, 1, 2, 10)))
    with pytest.raises(UsageError, match="2 parts that no edge connects; one has 2 vertices: 10, 11"):
        require_connected(path, read_g2o(path))


def test_unknown_tags_are_counted(tmp_path: Path) -> None:
    assert read_g2o(file(tmp_path, "PARAMS_X 1", f"EDGE_SE2 0 1 1 0 0 {I3}", "PARAMS_X 2")).ignored == {"PARAMS_X": 2}
