# SPDX-License-Identifier: Apache-2.0
"""PLY point clouds, as used by CloudCompare, MeshLab, Open3D and Blender: writes binary, reads binary and ASCII."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import UsageError
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array, Points

_HEADER = """ply
format binary_little_endian 1.0
comment dpm2: metres, intensity 0..1
element vertex {count}
property float x
property float y
property float z
property float intensity
end_header
"""


def write_ply(path: Path | str, points: Points) -> None:
    """Write (N, 4) [x, y, z in m, intensity 0..1]; N may be 0.

    Raises:
        Dpm2Error: the file could not be written; an older one at `path` is kept.
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"{path}: points are {points.shape}, want (N, 4)")
    with atomic_write(path, "wb") as file:
        file.write(_HEADER.format(count=len(points)).encode("ascii"))
        file.write(np.ascontiguousarray(points, "<f4").data)


_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
_FORMATS = ("binary_little_endian", "binary_big_endian", "ascii")


def read_ply(path: Path | str, names: Sequence[str]) -> Array:
    """(N, len(names)) float64: these properties of the vertices, see `read_vertices`.

    Raises:
        UsageError: no such file, or it is not PLY, is cut short, or lacks one of the properties.
    """
    vertices = read_vertices(path)
    if missing := [name for name in names if name not in vertices]:
        raise UsageError(f"{path}: no property {missing[0]}; it has {', '.join(vertices)}")
    return np.stack([vertices[name].astype(np.float64) for name in names], 1)


def read_vertices(path: Path | str) -> dict[str, NDArray[Any]]:
    """Properties of the vertices (the first element) of a PLY, binary or ASCII: name to (N,) values.

    Raises:
        UsageError: no such file, or it is not PLY, or is cut short.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    header = [line.split() for line in data[: max(end, 0)].decode("ascii", "replace").splitlines()]
    coding = next((line[1] for line in header if line[:1] == ["format"] and line[2:] == ["1.0"]), "")
    if ["ply"] not in header[:1] or coding not in _FORMATS or not start:
        raise UsageError(f"{path}: no PLY of version 1.0, binary or ASCII")
    elements = [i for i, line in enumerate(header) if line[:1] == ["element"]]
    try:
        first, last = elements[0], [*elements, len(header)][1]
        count = int(header[first][2])
        layout = np.dtype([(line[2], _TYPES[line[1]]) for line in header[first + 1 : last] if line[0] == "property"])
    except (IndexError, ValueError, KeyError) as error:
        raise UsageError(f"{path}: header of the PLY is damaged ({error})") from None
    names = layout.names or ()
    min_bytes = len(names) if coding == "ascii" else layout.itemsize  # bytes per vertex
    if count < 0 or len(data) - start < count * min_bytes:
        raise UsageError(f"{path}: ends before its {count} points do")
    if not count or not names:
        return {name: np.empty(0, layout[name]) for name in names}
    if coding == "ascii":
        vertices = _from_text(path, data[start:], layout, count)
    else:
        stored_layout = layout.newbyteorder(">") if coding == "binary_big_endian" else layout
        vertices = np.frombuffer(data, stored_layout, count, start).astype(layout, copy=False)
    return {name: vertices[name] for name in names}


def _from_text(path: Path | str, data: bytes, layout: np.dtype[Any], count: int) -> NDArray[Any]:
    """(count,) vertices with this layout, one per line."""
    try:
        vertices = np.loadtxt(BytesIO(data), layout, comments=None, max_rows=count, ndmin=1, encoding="ascii")
    except ValueError as error:
        raise UsageError(f"{path}: damaged ({error})") from None
    if len(vertices) < count:
        raise UsageError(f"{path}: ends before its {count} points do")
    return np.asarray(vertices)
