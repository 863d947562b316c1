# SPDX-License-Identifier: Apache-2.0
"""Images: runs from above (map, estimated and true trajectory), and the data of a failing sensor."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dpm2_core.evaluation.canvas import BACKGROUND, ESTIMATE, INK, new_figure, save_png
from dpm2_core.evaluation.kitti_metric import known
from dpm2_core.evaluation.metrics import align
from dpm2_core.extras import needs
from dpm2_core.frame import Array, Frame, Points

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TRUTH_COLOR = "#ffffff"
_HEIGHT_COLORS = ("#3d4f8f", "#2f8f9d", "#7fd1ae", "#f6f3c0")  # ground to roofs
_RASTER_PIXELS = 1100  # of the map raster along its longer side: about 0.15 m for a street, with voxels of 0.2 m
_MARGIN = 45.0  # m of map shown around the trajectory; beyond it a LiDAR map is mostly stray points


def trajectory_png(
    path: Path | str, est: Array, gt: Array | None = None, cloud: Points | None = None, title: str = ""
) -> None:
    """Draw a top view, x to the right and y up, to scale.

    Args:
        est: (N, 4, 4) poses in the map frame, z up.
        gt: (N, 4, 4) of the same frames, NaN where unknown, in any world frame: aligned by its positions.
        cloud: (M, 3+) map points in the map frame, m; colored by height.

    Raises:
        Dpm2Error: the file could not be written.
    """
    truth = None if gt is None else _aligned(gt, est)
    est = est[known(est)]
    low, high = _bounds(est[:, :3, 3], cloud)
    width, height = high - low
    figure = new_figure(figsize=(12, float(np.clip(12 * height / width, 3.5, 12)) + 0.8), dpi=150, facecolor=BACKGROUND)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.92), facecolor=BACKGROUND, aspect="equal")
    axes.set_axis_off()
    if cloud is not None and len(cloud):
        axes.imshow(_raster(cloud, est[:, :3, 3], low, high), extent=(low[0], high[0], low[1], high[1]), origin="lower")
    if truth is not None:
        axes.plot(truth[:, 0], truth[:, 1], "--", color=_TRUTH_COLOR, lw=1.2, label="ground truth (aligned)", zorder=4)
    axes.plot(est[:, 0, 3], est[:, 1, 3], color=ESTIMATE, lw=3.0, label="estimate", zorder=3)
    axes.plot(*est[0, :2, 3], "o", color=ESTIMATE, ms=8, mec=BACKGROUND, label="start", zorder=5)
    axes.plot(*est[-1, :2, 3], "s", color=ESTIMATE, ms=8, mec=BACKGROUND, label="end", zorder=5)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.legend(loc="upper right", facecolor=BACKGROUND, edgecolor="none", labelcolor=INK, framealpha=0.7)
    _scale_bar(axes, low, high)
    figure.text(0.02, 0.955, title, color=INK, fontsize=14)
    save_png(path, figure)


def trajectories_png(path: Path | str, trajectories: Mapping[str, Array], truth: Array | None, title: str) -> None:
    """Draw the trajectories (N, 3), m, of several methods and the true one from above, all in one frame.

    Raises:
        Dpm2Error: the file could not be written.
    """
    figure = new_figure(figsize=(9, 9), dpi=130, facecolor=BACKGROUND)
    axes = figure.add_axes((0.07, 0.05, 0.9, 0.9), facecolor=BACKGROUND, aspect="equal")
    if truth is not None:
        axes.plot(truth[:, 0], truth[:, 1], "--", color=_TRUTH_COLOR, lw=1.5, label="ground truth", zorder=9)
    for name, positions in trajectories.items():
        axes.plot(positions[:, 0], positions[:, 1], lw=1.5, label=name)
    axes.tick_params(colors=INK)
    axes.set_xlabel("m", color=INK)
    axes.legend(facecolor=BACKGROUND, edgecolor="none", labelcolor=INK)
    figure.text(0.07, 0.965, title, color=INK, fontsize=13)
    save_png(path, figure)


def corrupted_png(path: Path | str, before: Frame, after: Frame, title: str) -> None:
    """Draw a frame as it is and as from a failing sensor: the scan from above, and the image.

    Raises:
        Dpm2Error: the file could not be written.
    """
    rows = 2 if before.images else 1
    figure = new_figure(figsize=(12, 6.4 * rows - 3 * (rows - 1)), dpi=110, facecolor=BACKGROUND)
    for column, frame in enumerate((before, after)):
        axes = figure.add_subplot(rows, 2, 1 + column, facecolor=BACKGROUND, aspect="equal")
        axes.scatter(frame.points[:, 0], frame.points[:, 1], s=0.15, c=ESTIMATE, linewidths=0)
        axes.set(xlim=(-40, 40), ylim=(-40, 40), xticks=[], yticks=[])
        if frame.images:
            axes = figure.add_subplot(rows, 2, 3 + column, facecolor=BACKGROUND)
            axes.imshow(frame.images[0].pixels)
            axes.set_axis_off()
    figure.suptitle(title, color=INK)
    save_png(path, figure)


def _aligned(gt: Array, est: Array) -> Array | None:
    """Known positions of the ground truth (K, 3) in the map frame; None with fewer than two in common."""
    has_gt, common = known(gt), known(gt) & known(est)
    if common.sum() < 2:
        return None
    T_map_gt = align(gt[common, :3, 3], est[common, :3, 3])
    return gt[has_gt, :3, 3] @ T_map_gt[:3, :3].T + T_map_gt[:3, 3]


def _bounds(positions: Array, cloud: Points | None) -> tuple[Array, Array]:
    """Corners (2,), (2,) of the drawn area: the trajectory with a margin, which is cut to the area with map points."""
    low, high = positions[:, :2].min(0) - _MARGIN, positions[:, :2].max(0) + _MARGIN
    if cloud is not None and len(cloud):
        margin = 3.0
        low = np.maximum(low, np.minimum(np.percentile(cloud[:, :2], 0.5, axis=0), positions[:, :2].min(0)) - margin)
        high = np.minimum(high, np.maximum(np.percentile(cloud[:, :2], 99.5, axis=0), positions[:, :2].max(0)) + margin)
    return low, high


def _raster(cloud: Points, positions: Array, low: Array, high: Array) -> NDArray[np.float64]:
    """(H, W, 3) image of the points: hue from the highest in each pixel, brightness from their number.

    Heights are relative to the nearest of the (N, 3) positions of the LiDAR: a street on a hill must not be brighter
    than houses in the valley. Pixels are no finer than the spacing of the points, so that surfaces have no gaps.
    """
    with needs("plot", "drawing"):
        from matplotlib.colors import LinearSegmentedColormap, to_rgb

    cloud = cloud[np.logical_and.reduce((cloud[:, :2] > low) & (cloud[:, :2] < high), axis=1), :3]
    if not len(cloud):
        return np.full((1, 1, 3), to_rgb(BACKGROUND))
    nearest = KDTree(cloud).query(cloud[:: len(cloud) // 2000 + 1], k=[2])[0]
    pixel = max((high - low).max() / _RASTER_PIXELS, np.median(np.minimum(nearest, 1.0)))  # inf for a single point
    width, height = np.ceil((high - low) / pixel).astype(int)
    x, y = ((cloud[:, :2] - low) / pixel).astype(int).T
    z = cloud[:, 2] - positions[KDTree(positions[:, :2]).query(cloud[:, :2])[1], 2]
    cell = np.minimum(y, height - 1) * width + np.minimum(x, width - 1)
    count = np.bincount(cell, minlength=width * height)
    highest = np.full(width * height, -np.inf)
    np.maximum.at(highest, cell, z)
    low_z, high_z = np.percentile(z, [3, 95])
    heights = LinearSegmentedColormap.from_list("heights", _HEIGHT_COLORS)
    hue = heights(np.clip((highest - low_z) / max(high_z - low_z, 1e-3), 0, 1))[:, :3]
    brightness = np.where(count > 0, 0.4 + 0.6 * np.clip(np.log1p(count) / np.log(6), 0, 1), 0.0)[:, None]
    return (np.array(to_rgb(BACKGROUND)) * (1 - brightness) + hue * brightness).reshape(height, width, 3)


def _scale_bar(axes: Axes, low: Array, high: Array) -> None:
    """A bar of 1, 2 or 5 times a power of ten meters, about a sixth of the width."""
    width = high[0] - low[0]
    decade = 10.0 ** np.floor(np.log10(width / 6))
    length = decade * max(step for step in (1, 2, 5) if step * decade <= width / 6)
    x, y = low + 0.03 * width
    axes.plot([x, x + length], [y, y], color=INK, lw=3, solid_capstyle="butt", zorder=5)
    axes.text(x + length / 2, y + 0.008 * width, f"{length:g} m", color=INK, ha="center", va="bottom", zorder=5)
