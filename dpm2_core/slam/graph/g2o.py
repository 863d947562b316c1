# SPDX-License-Identifier: Apache-2.0
"""Reads and writes g2o files, SE2 and SE3:QUAT, at full precision.

A line is `VERTEX_SE3:QUAT id x y z qx qy qz qw` or `EDGE_SE3:QUAT from to x y z qx qy qz qw` and the upper triangle of
the information matrix, translation first and rotation in rad, as gtsam, Ceres and SE-Sync read it (g2o itself means the
vector part of the quaternion, half the angle); or `VERTEX_SE2 id x y yaw`, `EDGE_SE2 from to x y yaw` and the triangle
of (x, y, yaw). `FIX id...` fixes poses. Format: R. Kuemmerle et al., "g2o: A general framework for graph
optimization", ICRA 2011.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpm2_core.errors import UsageError
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.graph.graph_data import GraphData, components, integrate

_VERTEX = {"VERTEX_SE2": 4, "VERTEX_SE3:QUAT": 8}  # numbers on a line
_EDGE = {"EDGE_SE2": 11, "EDGE_SE3:QUAT": 30}
_MAX_STARTS_RATIO = 0.1  # of the nodes: in an order with more breaks, edges between neighbors are chance, perhaps loops
_MAX_DISTANCE = 1e9  # m: beyond, float64 is off by tenths of micrometers, and squares of larger values are infinite
_TANGENT_ORDER = {True: np.array([3, 4, 2]), False: np.array([3, 4, 5, 0, 1, 2])}  # of the file's order, by planar


@dataclass(frozen=True, eq=False)
class G2o:
    """A pose graph with the additional information of the file.

    Attributes:
        graph: nodes in ascending order of their ids, or in the file's order if ids do not follow the drive. A node with
            an edge from the previous one continues a trajectory; all other edges are loops. Without VERTEX lines the
            poses are those of the odometry.
        ids: (N,) of the file.
        planar: the file has SE2 lines: z, roll and pitch are zero and their variances arbitrary.
        ignored: number of lines of each unknown tag.
    """

    graph: GraphData
    ids: NDArray[np.int64]
    planar: bool
    ignored: dict[str, int] = field(default_factory=dict)


def read_g2o(path: Path) -> G2o:
    """Read a file.

    Raises:
        UsageError: it cannot be read or is no such graph; names the file and, if there is one, the line.
    """
    lines, ignored, fixed_ids = _read_lines(path)
    kinds = {tag.endswith("SE2") for tag in lines}
    if len(kinds) == 2:
        raise UsageError(f"{path}: SE2 and SE3 lines in one graph")
    planar = kinds == {True}
    suffix = "SE2" if planar else "SE3:QUAT"
    vertices, edges = lines.get(f"VERTEX_{suffix}", _Lines()), lines.get(f"EDGE_{suffix}", _Lines())
    if not edges.numbers:
        raise UsageError(f"{path}: no EDGE_SE2 or EDGE_SE3:QUAT line in it")
    values, edge_ids = _finite_numbers(path, edges), np.array(edges.ids, np.int64)
    T = _poses(path, edges, values, planar)
    covariances = _covariances(path, edges, values[:, (3 if planar else 7) :], planar)
    ids, poses = np.unique(edge_ids), None
    if vertices.numbers:
        vertex_values = _finite_numbers(path, vertices)
        vertex_ids = np.array(vertices.ids, np.int64)[:, 0]
        order = np.argsort(vertex_ids, kind="stable")
        if len(repeated := np.flatnonzero(np.diff(vertex_ids[order]) == 0)):
            line, vertex = vertices.line_numbers[order[repeated[0] + 1]], vertex_ids[order[repeated[0]]]
            raise UsageError(f"{path}:{line}: vertex {vertex} is defined again")
        if len(missing := np.setdiff1d(ids, vertex_ids)):
            line = edges.line_numbers[int(np.flatnonzero((edge_ids == missing[0]).any(1))[0])]
            raise UsageError(f"{path}:{line}: edge of vertex {missing[0]}, which has no VERTEX line")
        ids, poses = vertex_ids[order], _poses(path, vertices, vertex_values, planar)[order]
    ends = np.searchsorted(ids, edge_ids)
    file_order = (
        np.searchsorted(ids, vertex_ids) if vertices.numbers else np.argsort(np.unique(ends, return_index=True)[1])
    )
    if len(same := np.flatnonzero(ends[:, 0] == ends[:, 1])):
        raise UsageError(f"{path}:{edges.line_numbers[same[0]]}: edge from vertex {edge_ids[same[0], 0]} to itself")
    if unknown := sorted(set(fixed_ids) - set(ids.tolist())):
        raise UsageError(f"{path}: FIX {unknown[0]}: no such vertex")
    fixed = np.searchsorted(ids, np.array(sorted(set(fixed_ids)), np.int64))
    if _count_trajectories(file_order, ends) < min(
        _count_trajectories(np.arange(len(ids)), ends), len(ids) * _MAX_STARTS_RATIO
    ):
        position = np.argsort(file_order)
        ids, ends, fixed = ids[file_order], position[ends], np.sort(position[fixed])
        poses = None if poses is None else poses[file_order]
    graph = _to_graph_data(
        poses if poses is not None else np.tile(np.eye(4), (len(ids), 1, 1)), ends, T, covariances, fixed
    )
    if poses is None:
        graph = replace(graph, poses=integrate(graph))
    return G2o(graph, ids, planar, ignored)


def require_connected(path: Path, file: G2o) -> None:
    """Raises UsageError that names a part of the graph without an edge to the rest."""
    graph = file.graph
    part = components(len(graph), np.concatenate([graph.odometry_ends, graph.ends]))
    sizes = np.bincount(part)
    if len(sizes) > 1:
        members = file.ids[part == np.argmin(sizes)]
        some = ", ".join(map(str, members[:5])) + (", ..." if len(members) > 5 else "")
        raise UsageError(f"{path}: {len(sizes)} parts that no edge connects; one has {len(members)} vertices: {some}")


def write_g2o(path: Path, file: G2o, loops: NDArray[np.bool_] | None = None) -> None:
    """Write all vertices, FIX lines, odometry and the chosen loops (default: all) with 17 digits.

    Raises:
        Dpm2Error: the file could not be written.
    """
    graph, suffix = file.graph, "SE2" if file.planar else "SE3:QUAT"
    chosen = np.arange(len(graph.ends)) if loops is None else np.flatnonzero(loops)
    steps = np.flatnonzero(graph.chained)
    ends = np.concatenate([graph.odometry_ends, graph.ends[chosen]])
    T = np.concatenate([graph.steps[steps], graph.T_from_to[chosen]])
    covariances = np.concatenate([graph.step_covariances[steps], graph.constraint_covariances[chosen]])
    order = _TANGENT_ORDER[file.planar]
    information = np.linalg.inv(covariances[:, order[:, None], order])
    upper = np.triu_indices(len(order))
    with atomic_write(path) as out:
        for id, pose in zip(file.ids, _pose_numbers(graph.poses, file.planar), strict=True):
            out.write(f"VERTEX_{suffix} {id} {_format_numbers(pose)}\n")
        for node in graph.fixed:
            out.write(f"FIX {file.ids[node]}\n")
        for (a, b), pose, matrix in zip(file.ids[ends], _pose_numbers(T, file.planar), information, strict=True):
            out.write(f"EDGE_{suffix} {a} {b} {_format_numbers(pose)} {_format_numbers(matrix[upper])}\n")


class _Lines:
    """The ids and numbers of all lines of one tag, and their line numbers."""

    def __init__(self) -> None:
        self.ids: list[list[int]] = []  # separate from the numbers: gtsam's 64-bit keys do not fit into float64
        self.numbers: list[list[float]] = []
        self.line_numbers: list[int] = []


def _read_lines(path: Path) -> tuple[dict[str, _Lines], dict[str, int], list[int]]:
    lines: dict[str, _Lines] = {}
    ignored: dict[str, int] = {}
    fixed: list[int] = []
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"{path}: no text file") from None
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        tag, expected = words[0], _VERTEX.get(words[0]) or _EDGE.get(words[0])
        try:
            if tag == "FIX":
                fixed += [_id(word) for word in words[1:]]
            elif expected is None:
                ignored[tag] = ignored.get(tag, 0) + 1
            else:
                if len(words) - 1 != expected:
                    raise UsageError(f"{tag} with {len(words) - 1} numbers, want {expected}")
                ids = 1 if tag in _VERTEX else 2
                rows = lines.setdefault(tag, _Lines())
                rows.ids.append([_id(word) for word in words[1 : 1 + ids]])
                rows.numbers.append([float(word) for word in words[1 + ids :]])
                rows.line_numbers.append(number)
        except UsageError as error:
            raise UsageError(f"{path}:{number}: {error}") from None
        except ValueError:
            raise UsageError(f"{path}:{number}: not a number in: {' '.join(words)[:60]}") from None
    return lines, ignored, fixed


def _id(word: str) -> int:
    number = int(word)
    if abs(number) >= 2**63:
        raise UsageError(f"vertex {word}: ids have 63 bits")
    return number


def _finite_numbers(path: Path, lines: _Lines) -> Array:
    values = np.array(lines.numbers)
    if len(bad := np.flatnonzero(~np.isfinite(values).all(1))):
        raise UsageError(f"{path}:{lines.line_numbers[bad[0]]}: a number that is not finite")
    return values


def _poses(path: Path, lines: _Lines, values: Array, planar: bool) -> Array:
    """Leading numbers of (N, 3+) x y yaw or (N, 7+) x y z qx qy qz qw to (N, 4, 4)."""
    if len(bad := np.flatnonzero(np.abs(values[:, : 2 if planar else 3]).max(1) > _MAX_DISTANCE)):
        raise UsageError(f"{path}:{lines.line_numbers[bad[0]]}: farther than {_MAX_DISTANCE / 1000:.0f} km")
    if planar:
        R = Rotation.from_rotvec(values[:, 2:3] * [0, 0, 1]).as_matrix()
        return se3.make(R, np.column_stack([values[:, :2], np.zeros(len(values))]))
    if len(bad := np.flatnonzero(np.abs(np.linalg.norm(values[:, 3:7], axis=1) - 1) > 1e-2)):
        raise UsageError(f"{path}:{lines.line_numbers[bad[0]]}: the quaternion is not of unit length")
    return se3.make(Rotation.from_quat(values[:, 3:7]).as_matrix(), values[:, :3])


def _covariances(path: Path, lines: _Lines, upper: Array, planar: bool) -> Array:
    """(E, 6, 6) [rotation, translation] from the upper triangles in the file's order."""
    order = _TANGENT_ORDER[planar]
    size = len(order)
    rows, columns = np.triu_indices(size)
    information = np.zeros((len(upper), size, size))
    information[:, rows, columns] = information[:, columns, rows] = upper
    # Scaled by the diagonal, since units differ, and unmeasured components may have 1e-15 of the weight of the rest.
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.where(diagonal > 1e-100, diagonal, 1.0))
    weights = np.linalg.eigvalsh(scale[:, :, None] * information * scale[:, None, :])
    if len(bad := np.flatnonzero(weights[:, 0] <= 1e-12)):
        least = np.linalg.eigvalsh(information[bad[0]])[0]
        raise UsageError(
            f"{path}:{lines.line_numbers[bad[0]]}: information matrix not positive definite, least value {least:.3g}"
        )
    covariances = np.linalg.inv(information)
    out = np.zeros((len(upper), 6, 6))
    out[:, order[:, None], order] = (covariances + np.swapaxes(covariances, -1, -2)) / 2
    if planar:  # nothing ever moves in these three; variances like the others' keep the matrix well conditioned
        out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2]
        out[:, 5, 5] = (out[:, 3, 3] + out[:, 4, 4]) / 2
    return out


def _count_trajectories(order: NDArray[np.intp], ends: NDArray[np.intp]) -> int:
    """Number of trajectories if nodes are in this order."""
    position = np.argsort(order)
    pairs = np.sort(position[ends], axis=1)
    return len(order) - len(np.unique(pairs[pairs[:, 1] - pairs[:, 0] == 1, 1]))


def _to_graph_data(
    poses: Array, ends: NDArray[np.intp], T: Array, covariances: Array, fixed: NDArray[np.intp]
) -> GraphData:
    """Separate the odometry from the loops: the first edge between two neighboring nodes is odometry."""
    count = len(poses)
    backward = ends[:, 0] - ends[:, 1] == 1
    adjoint = se3.adjoint(T)  # the covariance of T_b_a is that of T_a_b, seen from the other end
    T = np.where(backward[:, None, None], se3.inverse(T), T)
    flipped_covariances = adjoint @ covariances @ np.swapaxes(adjoint, -1, -2)
    covariances = np.where(backward[:, None, None], flipped_covariances, covariances)
    ends = np.where(backward[:, None], ends[:, ::-1], ends)
    neighboring = np.flatnonzero(ends[:, 1] - ends[:, 0] == 1)
    nodes, first = np.unique(ends[neighboring, 1], return_index=True)
    odometry = neighboring[first]
    chained, steps = np.zeros(count, np.bool_), np.tile(np.eye(4), (count, 1, 1))
    step_covariances = np.zeros((count, 6, 6))
    chained[nodes], steps[nodes], step_covariances[nodes] = True, T[odometry], covariances[odometry]
    loops = np.setdiff1d(np.arange(len(ends)), odometry)
    return GraphData(poses, chained, steps, step_covariances, ends[loops], T[loops], covariances[loops], fixed)


def _pose_numbers(T: Array, planar: bool) -> Array:
    """(N, 3) x y yaw or (N, 7) x y z qx qy qz qw with qw >= 0."""
    if planar:
        return np.column_stack([T[:, :2, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    return np.column_stack([T[:, :3, 3], se3.quaternion(T)])


def _format_numbers(numbers: Iterable[float] | Sequence[float]) -> str:
    return " ".join(f"{x:.17g}" for x in numbers)
