# SPDX-License-Identifier: Apache-2.0
"""Recovers the good part of a damaged map file: row by row, each checked separately."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Container, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dpm2_core.data.thumbnail import image_of
from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe, Registration, isotropic
from dpm2_core.frame import NO_POINTS, Array, Georeference
from dpm2_core.geometry import se3
from dpm2_core.slam.store import rows, schema
from dpm2_core.slam.store.cloud_codec import pack_cloud, unpack_cloud, unpack_mask
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_data import MapData, odometry_by_node, subset
from dpm2_core.slam.store.rows import RemovedKeyframe, Session

_MIN_ROW_BYTES = 20  # limits the number of rows, so that a small file cannot have a row 2^62
_MAX_HIDDEN_ROWS = 30_000  # consecutive rows that one damaged page of a tree can hide
_Payload = tuple[bytes | None, Descriptors | None, bytes | None]
_BRIDGE_COVARIANCE = isotropic(0.05, 0.5)  # of an edge that bridges a lost keyframe


@dataclass
class Findings:
    """Results of a check.

    Attributes:
        problems: one line each; empty if the map is good.
        keyframes: number of usable ones. lost: number of unusable ones; a lower bound if the end of the map cannot be
            read. lost_clouds: number of usable ones without their payload.
    """

    problems: list[str] = field(default_factory=list)
    keyframes: int = 0
    lost: int = 0
    lost_clouds: int = 0


class Salvage:
    """Reads as much of a map as possible."""

    def __init__(self, sql: sqlite3.Connection, size: int, findings: Findings) -> None:
        """`size`: file size, bytes."""
        self._sql, self._max_rows, self._findings = sql, size // _MIN_ROW_BYTES, findings
        self._channels = 0  # of most descriptors
        self._last_rows = {table: self._find_last_row(table) for table in schema.CONTENT}

    def run(self) -> MapData:
        """All good data, without gaps."""
        keyframes, loans = self._read_keyframes()
        poses = self._read_poses(keyframes)
        good = sorted(keyframes)
        last = max(good, default=-1) + 1
        moving: list[bytes | None] = [None] * last
        for node, mask in self._read_rows("moving"):
            with self._recording(f"keyframe {node}: its mask of moving points is lost"):
                if node in keyframes and (cloud := self._read_payload(node)[0]) is not None:
                    unpack_mask(mask, len(unpack_cloud(cloud)))
                    moving[node] = mask
        self._assign_fixes(keyframes)
        edges = self._read_edges(keyframes)
        trail = self._read_trail(keyframes)
        # A map with the old numbers and gaps; the good nodes are then taken from it.
        empty_cloud = pack_cloud(NO_POINTS)
        filler = Keyframe(0, 0, 0, np.eye(4), NO_POINTS, session=1)
        with_gaps = MapData(
            [keyframes.get(node, filler) for node in range(last)],
            np.array([poses.get(node, np.eye(4)) for node in range(last)]).reshape(-1, 4, 4),
            [],
            [],
            self._read_sessions(keyframes),
            CloudStore(
                lambda node: self._read_payload(node)[0] or (None if node in loans else empty_cloud), moving, loans
            ),
            lambda node: self._read_payload(node)[2],
            self._describe,
            georeference=self._read_georeference(),
        )
        return subset(with_gaps, good, edges, trail)

    def _read_keyframes(self) -> tuple[dict[int, Keyframe], dict[int, Loan]]:
        keyframes: dict[int, Keyframe] = {}
        loans: dict[int, Loan] = {}
        for row in self._read_rows("keyframes"):
            with self._recording(f"keyframe {row[0]}"):
                node, keyframes[row[0]], loan = rows.keyframe_of(row)
                if loan is not None:
                    loans[node] = loan
        end = max(self._last_rows[table] for table in ("keyframes", "payloads", "poses")) + 1
        if missing := sorted(set(range(end)) - keyframes.keys()):
            self._report(f"keyframes lost: {_format_numbers(missing)}")
            self._findings.lost = len(missing)
        for node, loan in list(loans.items()):
            if loan.lender not in keyframes or loan.lender in loans:
                self._report(f"keyframe {node}: borrows the cloud of {loan.lender}, which is lost or has none")
                del loans[node]
        for node in loans:
            with self._recording(f"keyframe {node}: its own cloud is lost"):
                if (payload := self._read_row("payloads", node)) is not None:
                    unpack_cloud(payload[1])
        channels: dict[int, int] = {}
        for node in (node for node in keyframes if node not in loans):
            cloud, descriptors, _ = self._read_payload(node, complain=True)
            self._findings.lost_clouds += cloud is None
            if descriptors is not None:
                channels[node] = descriptors.features.shape[1]
        (self._channels, _), *_ = Counter(channels.values()).most_common(1) or [(0, 0)]
        for node, count in channels.items():
            if count != self._channels:
                self._report(f"keyframe {node}: its descriptors are lost: {count} channels, most have {self._channels}")
        return keyframes, loans

    def _describe(self, node: int) -> Descriptors | None:
        """Descriptors of a node, if they are good and can be compared with those of most others."""
        descriptors = self._read_payload(node)[1]
        return None if descriptors is None or descriptors.features.shape[1] != self._channels else descriptors

    def _read_payload(self, node: int, complain: bool = False) -> _Payload:
        """Packed cloud, descriptors and thumbnail of a node, if they are good."""
        try:
            row = self._read_row("payloads", node)
            if row is None:
                raise ValueError("none there")
            unpack_cloud(row[1])
            descriptors = None if row[2] is None else rows.unpack_descriptors(row[2])
            return row[1], descriptors, self._check_thumbnail(node, row[3], complain)
        except (ValueError, TypeError) as error:
            if complain:
                self._report(f"keyframe {node}: its payload is lost: {error}")
            return None, None, None

    def _check_thumbnail(self, node: int, jpeg: bytes | None, complain: bool) -> bytes | None:
        try:
            if jpeg is not None:
                image_of(jpeg)
        except ValueError as error:
            if complain:
                self._report(f"keyframe {node}: {error}")
            return None
        return jpeg

    def _read_poses(self, keyframes: dict[int, Keyframe]) -> dict[int, Array]:
        """T_map_kf by node; a lost one is computed from the previous keyframe by odometry."""
        stored = dict(self._read_rows("poses"))
        poses: dict[int, Array] = {}
        T_map_odom = np.eye(4)
        for node in sorted(keyframes):
            try:
                if node not in stored:
                    raise ValueError("lost")
                T = rows.pose_of(stored[node])
            except ValueError as error:
                self._report(f"keyframe {node}: its optimized pose is {error}")
                T = T_map_odom @ keyframes[node].T_odom_kf
            poses[node] = T
            T_map_odom = T @ se3.inverse(keyframes[node].T_odom_kf)
        return poses

    def _assign_fixes(self, keyframes: dict[int, Keyframe]) -> None:
        """Assign the good fixes to their keyframes."""
        for row in self._read_rows("fixes"):
            with self._recording(f"keyframe {row[0]}: its fix is lost"):
                node, fix = rows.fix_of(row)
                keyframes[node] = replace(keyframes[node], fix=fix)

    def _read_georeference(self) -> Georeference | None:
        for row in self._read_rows("georeference"):
            with self._recording("georeference"):
                return rows.georeference_of(row)
        return None

    def _read_edges(self, keyframes: dict[int, Keyframe]) -> list[Edge]:
        """Edges between existing keyframes, and edges that bridge lost ones."""
        edges, known = [], []
        for row in self._read_rows("edges"):
            with self._recording(f"edge {row[0]}"):
                edge = rows.edge_of(row)
                known.append(edge)
                rows.check_ends(edge, keyframes)
                edges.append(edge)
        return [*edges, *self._bridge_gaps(known, keyframes)]

    def _bridge_gaps(self, known: list[Edge], keyframes: dict[int, Keyframe]) -> Iterator[Edge]:
        """Odometry edges over the gaps of lost keyframes and edges.

        `known`: edges, also from and to lost keyframes. A node without an odometry edge to it begins a drive; if edges
        are lost, too, only if its frame count restarts.
        """
        chain, some_lost = odometry_by_node(known), len(known) <= self._last_rows["edges"]
        connected = {edge.to_node for edge in known if edge.kind == "odometry" and edge.from_node in keyframes}
        newest: dict[tuple[str, int], int] = {}
        for node, b in sorted(keyframes.items()):
            drive = b.robot, b.session
            previous, origin = newest.get(drive), _predecessor(node, chain, keyframes)
            newest[drive] = node
            if previous is None or node in connected:
                continue
            a = keyframes[previous]
            if origin == previous or (origin is None and some_lost and a.index < b.index):
                T_a_b = se3.inverse(a.T_odom_kf) @ b.T_odom_kf
                yield Edge("odometry", previous, node, Registration(T_a_b, _BRIDGE_COVARIANCE, method="bridge"))

    def _read_trail(self, keyframes: dict[int, Keyframe]) -> list[RemovedKeyframe]:
        trail = []
        for row in self._read_rows("trail"):
            with suppress(ValueError):
                if (pruned := rows.removed_of(row)).node in keyframes:
                    trail.append(pruned)
                    continue
            self._report(f"trail {row[0]}: not a pose relative to an existing keyframe")
        return trail

    def _read_sessions(self, keyframes: dict[int, Keyframe]) -> list[Session]:
        try:
            return [rows.session_of(row) for row in self._sql.execute("SELECT * FROM sessions ORDER BY session")]
        except (sqlite3.DatabaseError, ValueError) as error:
            self._report(f"sessions: {error}")
            return [Session(number, "", "", "", "") for number in sorted({k.session for k in keyframes.values()})]

    def _read_rows(self, table: str) -> Iterator[tuple[Any, ...]]:
        """The good rows of a table, each read by its number, so that a damaged page costs only its own rows."""
        for number in range(self._last_rows[table] + 1):
            row = None
            with self._recording(f"{table} {number}"):
                row = self._read_row(table, number)
            if row is not None:
                yield row

    def _read_row(self, table: str, number: int) -> tuple[Any, ...] | None:
        query = f"SELECT {', '.join(schema.CONTENT[table])}, crc FROM {table} WHERE rowid = ?"
        try:
            row = self._sql.execute(query, (number,)).fetchone()
        except (sqlite3.DatabaseError, OverflowError, UnicodeDecodeError) as error:
            raise ValueError(str(error)) from None
        if row is None:
            return None
        try:
            intact = schema.row_crc(*row[:-1]) == row[-1]
        except Exception:  # values of types that no row has
            intact = False
        if not intact:
            raise ValueError("its checksum is wrong")
        return tuple(row[:-1])

    def _find_last_row(self, table: str) -> int:
        """Number of the last row of a table, -1 without any; if its end is damaged, of the first lost row."""
        with suppress(sqlite3.DatabaseError):
            first = self._sql.execute(f"SELECT coalesce(min(rowid), 0) FROM {table}").fetchone()[0]
            if first < 0:
                self._report(f"{table}: rows before 0, from {first}")
        try:
            last = int(self._sql.execute(f"SELECT coalesce(max(rowid), -1) FROM {table}").fetchone()[0])
        except sqlite3.DatabaseError:
            lost = self._find_last_readable(table) + 1
            self._report(f"{table}: rows from {lost} on cannot be read, and how many there are is not known")
            return lost
        if last > self._max_rows:
            self._report(f"{table}: row number {last} in a file of at most {self._max_rows} rows")
        return min(last, self._max_rows)

    def _find_last_readable(self, table: str) -> int:
        """Searched from the first row upward, since the path to the last one leads through the damage."""
        last, number = -1, 0
        while number <= min(last + _MAX_HIDDEN_ROWS, self._max_rows):
            with suppress(sqlite3.DatabaseError):
                if self._sql.execute(f"SELECT 1 FROM {table} WHERE rowid = ?", (number,)).fetchone():
                    last = number
            number += 1
        return last

    @contextmanager
    def _recording(self, what: str) -> Iterator[None]:
        """Record errors in this block as a problem and continue."""
        try:
            yield
        except (ValueError, TypeError, KeyError) as error:
            self._report(f"{what}: {error}")

    def _report(self, text: str) -> None:
        self._findings.problems.append(text)


def _format_numbers(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:10])) + (f" and {len(numbers) - 10} more" if len(numbers) > 10 else "")


def _predecessor(node: int, chain: Mapping[int, Edge], there: Container[int]) -> int | None:
    """The existing node from which odometry leads to another one, over lost ones; None if a drive begins there."""
    while node in chain:
        node = chain[node].from_node
        if node in there:
            return node
    return None
