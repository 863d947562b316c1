# SPDX-License-Identifier: Apache-2.0
"""Maps of a ring road and of laps, made without a drive, for tests that show, write or search maps; contents of map
files."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe, Registration, isotropic
from dpm2_core.frame import NO_POINTS, Array, Fix, Georeference, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore, Loan
from dpm2_core.slam.store.map_data import MapData
from dpm2_core.slam.store.map_store import Change
from dpm2_core.slam.store.rows import Session

SPACING = 5.0
"""m between keyframes."""
FIRM = isotropic(1e-3, 0.02)
"""(6, 6) covariance of a good odometry."""
SESSION = Session(1, "0", "2026-01-01T00:00:00Z", "", "")
GEOREFERENCE = Georeference(np.array([49.0, 8.4, 110.0]), se3.exp(np.array([0, 0, 1.0, 2, 3, 4])))
FIX = Fix(5, np.array([49.0, 8.4, 110.5]), np.diag([4.0, 4, 16]), np.array([0.1, 0, 1.5]))


def ring(count: int, points: int = 2000, image: tuple[int, int] | None = None) -> MapData:
    """Map of keyframes around a circle, counterclockwise from its rightmost point, with walls of 8 m on both sides of
    the road.

    Args:
        points: number per cloud. image: width and height of the thumbnails, which are noise; None: no thumbnails.
    """
    rng = np.random.default_rng(1)
    radius = max(15.0, SPACING * count / (2 * np.pi))
    angles = 2 * np.pi * np.arange(count) / count
    poses = np.array([_pose(radius, angle) for angle in angles])
    clouds = stored(_walls(rng, T, radius, points) for T in poses)
    keyframes = [Keyframe(i, 10**9 * i, 10 * i, T, NO_POINTS, session=1) for i, T in enumerate(poses)]
    steps = [_edge("odometry", i, i + 1, poses) for i in range(count - 1)]
    loops = [_edge("loop", 0, count - 1, poses), _edge("loop", 0, count // 2, poses).rejected("<b>points</b> disagree")]
    pictures = [None if image is None else _noise(rng, image) for _ in range(3)]
    return MapData(keyframes, poses, [*steps, *loops], [], [SESSION], clouds, lambda node: pictures[node % 3])


def in_laps(clouds: Sequence[Points], poses: Array, laps: int, seen: Sequence[Descriptors]) -> MapData:
    """Map of `laps` laps past the first places, in which later laps borrow, and one pass along the other places.

    `poses`: (N, 4, 4) of all keyframes. There are fewer `clouds` (M, 4) and descriptors `seen`, those of the first lap.
    """
    count = len(clouds)
    keyframes = [Keyframe(i, i, i, T, NO_POINTS, None, "", seen[i % count], session=1) for i, T in enumerate(poses)]
    store = stored(clouds[node % count] for node in range(len(poses)))
    for node in range(count, laps * count):
        store.borrow(node, Loan(node % count, np.eye(4)))
    ways = [Registration(se3.inverse(one) @ other, FIRM) for one, other in pairwise(poses)]
    steps = [Edge("odometry", node, node + 1, way) for node, way in enumerate(ways)]
    return MapData(keyframes, poses, steps, [], [replace(SESSION, weights=SlamSettings().weights_id())], store)


def stored(clouds: Iterable[Points], origin: Array | None = None) -> CloudStore:
    """Store of keyframe clouds, each (M, 4), seen from the LiDAR's position `origin` (3,), m; by default the origin."""
    store = CloudStore()
    for cloud in clouds:
        store.append(pack_cloud(cloud, origin))
    return store


def change(node: int, keyframe: Keyframe, thumbnail: bytes | None = None) -> Change:
    """A keyframe at its odometry pose."""
    return Change([(node, keyframe, pack_cloud(keyframe.cloud), thumbnail)], poses={node: keyframe.T_odom_kf})


def execute(path: Path, *statements: str | tuple[str, tuple[object, ...]]) -> None:
    """Execute SQL on a file that is closed."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(*([statement] if isinstance(statement, str) else statement))


def _pose(radius: float, angle: float) -> np.ndarray:
    turn = se3.exp(np.array([0, 0, angle + np.pi / 2, 0, 0, 0]))[:3, :3]
    return se3.make(turn, np.array([radius * np.cos(angle), radius * np.sin(angle), 1.0]))


def _walls(rng: np.random.Generator, T: np.ndarray, radius: float, points: int) -> np.ndarray:
    at = np.arctan2(T[1, 3], T[0, 3]) + rng.uniform(-30, 30, points) / radius
    out = radius + rng.choice([-8.0, 8.0], points)
    world = np.column_stack([out * np.cos(at), out * np.sin(at), rng.uniform(0, 8, points)])
    local = se3.transform(se3.inverse(T), world)
    return np.column_stack([local, np.full(points, 0.5)]).astype(np.float32)


def _edge(kind: str, a: int, b: int, poses: np.ndarray) -> Edge:
    T = se3.inverse(poses[a]) @ poses[b]
    return Edge(kind, a, b, Registration(T, np.eye(6) * 1e-4, 0.9, 0.1, "points"))  # type: ignore[arg-type]


def _noise(rng: np.random.Generator, size: tuple[int, int]) -> bytes:
    pixels = rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    return bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
