# SPDX-License-Identifier: Apache-2.0
"""PLY files, read back by the rules of the format alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.ply import read_ply, read_vertices, write_ply
from dpm2_core.errors import UsageError


def _read(path: Path) -> tuple[list[str], np.ndarray]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    return head.decode("ascii").splitlines(), np.frombuffer(body, "<f4").reshape(-1, 4)


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_points_come_back_bit_for_bit(tmp_path: Path, count: int) -> None:
    points = np.random.default_rng(0).normal(size=(count, 4)).astype(np.float32)
    write_ply(tmp_path / "map.ply", points)
    header, body = _read(tmp_path / "map.ply")
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert f"element vertex {count}" in header
    assert [line.split()[1:] for line in header if line.startswith("property")] == [
        ["float", name] for name in ("x", "y", "z", "intensity")
    ]
    np.testing.assert_array_equal(body, points)


def test_any_memory_layout_and_float_type_will_do(tmp_path: Path) -> None:
    points = np.asfortranarray(np.arange(40, dtype=np.float64).reshape(10, 4))[::-2]
    write_ply(tmp_path / "map.ply", points)
    np.testing.assert_array_equal(_read(tmp_path / "map.ply")[1], points)


def test_an_independent_reader_agrees(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    points = np.random.default_rng(0).normal(size=(10, 4)).astype(np.float32)
    write_ply(tmp_path / "map.ply", points)
    vertices = plyfile.PlyData.read(tmp_path / "map.ply")["vertex"]
    np.testing.assert_array_equal(np.column_stack([vertices[n] for n in ("x", "y", "z", "intensity")]), points)


def test_points_of_another_shape_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"want \(N, 4\)"):
        write_ply(tmp_path / "map.ply", np.zeros((5, 3), np.float32))
    assert not list(tmp_path.iterdir())


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """Properties by name, in the requested order. A missing property, a text file and a truncated file are rejected by
    name."""
    points = np.random.default_rng(0).normal(size=(10, 4)).astype(np.float32)
    path = tmp_path / "map.ply"
    write_ply(path, points)
    np.testing.assert_array_equal(read_ply(path, ("intensity", "x")), points[:, [3, 0]])
    with pytest.raises(UsageError, match="no property time; it has x, y, z, intensity"):
        read_ply(path, ("time",))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(UsageError, match="ends before its 10 points do"):
        read_ply(path, ("x",))
    path.write_text("hello")
    with pytest.raises(UsageError, match=r"map\.ply: no PLY of version 1\.0, binary or ASCII"):
        read_ply(path, ("x",))


def _coded(coding: str, points: np.ndarray, body: bytes) -> bytes:
    properties = "property double x\nproperty uint t\nproperty uchar intensity\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    return f"ply\nformat {coding} 1.0\nelement vertex {len(points)}\n{properties}{faces}end_header\n".encode() + body


def test_big_endian_and_ascii_are_read(tmp_path: Path) -> None:
    """As written by MeshLab, Open3D and PCL. Previously, all scans of such a drive were unreadable."""
    points = np.array([(1.25, 4_000_000_000, 255), (-1e-3, 0, 0), (float("nan"), 7, 1)],
                      [("x", "<f8"), ("t", "<u4"), ("intensity", "u1")])  # fmt: skip
    text = "\r\n".join(" ".join(str(value) for value in row) for row in points.tolist()).encode()
    wide = points.astype(points.dtype.newbyteorder(">")).tobytes()
    for coding, body in (("binary_big_endian", wide), ("ascii", text + b"\n3 0 1 2\n")):
        (tmp_path / "scan.ply").write_bytes(_coded(coding, points, body))
        found = read_vertices(tmp_path / "scan.ply")
        assert {name: part.dtype for name, part in found.items()} == dict(points.dtype.descr)
        for name, part in found.items():
            np.testing.assert_array_equal(part, points[name])


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (b"1 2 3\n", "ends before"),
        (b"1 2 3\n4 5\n" * 9, "damaged"),
        (b"1 2 a\n" * 9, "damaged"),
        (b"\xff" * 99, "damaged"),
    ],
)
def test_damaged_text_is_an_error_that_names_the_file(tmp_path: Path, body: bytes, reason: str) -> None:
    (tmp_path / "scan.ply").write_bytes(_coded("ascii", np.zeros(2), body))
    with pytest.raises(UsageError, match=f"scan.ply: {reason}"):
        read_vertices(tmp_path / "scan.ply")
