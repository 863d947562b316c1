# SPDX-License-Identifier: Apache-2.0
"""A map as one HTML file: points in level of detail, trajectory, keyframes with images, loops with their verdicts."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dpm2_core.data.compressed import decode_compressed
from dpm2_core.estimates import Edge
from dpm2_core.evaluation.page import asset, data_url, escape, page
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array, Points
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.store.map_cloud import map_cloud
from dpm2_core.slam.store.map_data import MapData, ways

MOST_POINTS = 1_000_000
"""6 MB, 8 MB as text."""
IMAGES = 6_000_000
"""Bytes that all images together may take, 8 MB as text."""
_COARSEST_VOXEL = 12.8  # m, the first level of detail
_JPEG_QUALITY = 60  # quality of a JPEG that had to be made smaller


def write_map_page(path: Path, data: MapData, voxel: float) -> None:
    """Write the page; needs at least one keyframe.

    Args:
        voxel: spacing of its points, m; of more than `MOST_POINTS` those that show the least are left out.

    Raises:
        Dpm2Error: the file could not be written.
    """
    text = map_page(data, voxel, path.stem)
    with atomic_write(path) as file:
        file.write(text)


def map_page(data: MapData, voxel: float, title: str) -> str:
    """The page as text."""
    style, body, script = (asset(f"map.{kind}") for kind in ("css", "html", "js"))
    return page(title, body.replace("TITLE", escape(title)), style=style, script=script, data=_content(data, voxel))


def by_detail(cloud: Points, finest: float) -> Points:
    """The points in an order in which the first n points show the whole cloud evenly, in more detail for larger n.

    Args:
        cloud: (N, 4). finest: distance, m, below which distinguishing points gives no benefit.
    """
    rng = np.random.default_rng(0)
    rest, order, size = np.arange(len(cloud)), [], _COARSEST_VOXEL
    while len(rest):
        chosen = voxel_first(cloud[rest], size) if size > finest else np.arange(len(rest))
        order.append(rng.permutation(rest[chosen]))
        rest = np.delete(rest, chosen)
        size /= 2
    return cloud[np.concatenate(order)] if order else cloud


def _content(data: MapData, voxel: float) -> dict[str, Any]:
    """The data for the page's script: positions relative to the center of the keyframes."""
    center = data.poses[:, :3, 3].mean(0)
    cloud = by_detail(map_cloud(data.clouds, data.poses, voxel), 2 * voxel)[:MOST_POINTS]
    local = cloud[:, :3].astype(np.float64) - center
    scale = max(0.005, float(np.abs(local).max(initial=0.0)) / 32_000)
    packed = np.round(local / scale).astype("<i2")
    low, high = np.percentile(local[:, 2], [2, 98]) if len(local) else (0.0, 1.0)
    return {
        "scale": scale,
        "heights": [float(low), float(max(high, low + 1.0))],
        "points": base64.b64encode(packed.tobytes()).decode("ascii"),
        "middle": center.round(3).tolist(),
        "keyframes": _keyframes(data, center),
        "tracks": _tracks(data, center),
        "loops": [_loop(edge) for edge in data.edges if edge.kind == "loop"],
    }


def _keyframes(data: MapData, center: Array) -> list[dict[str, Any]]:
    jpegs = [data.thumbnail(node) for node in range(len(data))]
    max_bytes = IMAGES // max(1, sum(jpeg is not None for jpeg in jpegs))
    return [
        {
            "at": (T[:3, 3] - center).round(3).tolist(),
            "yaw": round(float(np.degrees(np.arctan2(T[1, 0], T[0, 0]))), 1),
            "stamp": str(keyframe.stamp),  # ns exceed the precision of a number in JavaScript
            "frame": keyframe.index,
            "robot": keyframe.robot,
            "session": keyframe.session,
            "image": None if (small := _shrink_image(jpeg, max_bytes)) is None else data_url(small, "image/jpeg"),
        }
        for keyframe, T, jpeg in zip(data.keyframes, data.poses, jpegs, strict=True)
    ]


def _tracks(data: MapData, center: Array) -> list[list[list[float]]]:
    """The trajectory of each drive, including keyframes that were pruned."""
    return [(drive.poses[:, :3, 3] - center).round(3).tolist() for drive in ways(data)]


def _loop(edge: Edge) -> dict[str, Any]:
    r = edge.registration
    rmse = round(r.rmse, 3) if np.isfinite(r.rmse) else None
    return {
        "from": edge.from_node, "to": edge.to_node, "ok": edge.ok, "reason": r.reason, "method": r.method,
        "confidence": round(r.confidence, 3) if np.isfinite(r.confidence) else None, "rmse": rmse,
    }  # fmt: skip


def _shrink_image(jpeg: bytes | None, max_bytes: int) -> bytes | None:
    """The image in at most `max_bytes` bytes, resized if necessary; None if there is none, or it is no JPEG."""
    if jpeg is None or not jpeg.startswith(b"\xff\xd8"):
        return None
    try:
        pixels = decode_compressed(jpeg)[:, :, ::-1]
    except ValueError:
        return None
    while len(jpeg) > max_bytes and min(pixels.shape[:2]) > 16:
        pixels = cv2.resize(pixels, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
    return jpeg if len(jpeg) <= max_bytes else None
