# SPDX-License-Identifier: Apache-2.0
"""Draws a cloud onto the image of the same time: wrong extrinsics are visible at every edge."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.frame import Image, Points
from dpm2_core.geometry import se3

_MIN_DEPTH, _MAX_DEPTH = 0.5, 60.0  # m in front of the camera
_MARGIN = 0.2  # of the image's size: the distortion model would fold points farther outside back into the image


def painted(image: Image, points: Points) -> NDArray[np.uint8]:
    """The pixels (H, W, 3) with the points (N, 4), in the LiDAR frame, drawn on them: red for near to blue for 60 m,
    near points over far ones. Points are drawn where they were measured, without de-skewing."""
    camera, pixels = image.camera, image.pixels.copy()
    width, height = camera.size
    xyz = points[np.isfinite(points[:, :3]).all(1), :3].astype(np.float64)
    xyz = np.asarray(se3.transform(se3.inverse(camera.T_lidar_cam), xyz), np.float64)
    xyz = xyz[(xyz[:, 2] > _MIN_DEPTH) & (xyz[:, 2] < _MAX_DEPTH)]
    undistorted = (xyz @ camera.K.T)[:, :2] / xyz[:, 2:]
    margin = _MARGIN * np.array([width, height])
    xyz = xyz[((undistorted > -margin) & (undistorted < margin + np.array([width, height]))).all(1)]
    if not len(xyz):
        return pixels
    uv, _ = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion, np.float64))
    u, v = np.round(uv[:, 0]).astype(np.int64).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = np.log(xyz[inside, 2] / _MIN_DEPTH) / np.log(_MAX_DEPTH / _MIN_DEPTH)
    nearness = np.zeros((height, width), np.uint8)  # 0: no point; 255: the nearest, which covers those behind it
    np.maximum.at(nearness, (v[inside], u[inside]), (255 * (1 - depth)).clip(1, 255).astype(np.uint8))
    point_size = 2 * (max(0, round(width / 640) - 1) + (width >= 320)) + 1  # pixels of a point
    nearness = np.asarray(cv2.dilate(nearness, np.ones((point_size, point_size), np.uint8)), np.uint8)
    shades = cv2.cvtColor(cv2.applyColorMap(nearness, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    return np.asarray(cv2.copyTo(shades, nearness, pixels), np.uint8)
