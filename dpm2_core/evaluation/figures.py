# SPDX-License-Identifier: Apache-2.0
"""Images: a run (map, estimated and true trajectory from above), and how often methods register pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dpm2_core.evaluation.canvas import new_figure, save_png
from dpm2_core.evaluation.kitti_metric import known
from dpm2_core.evaluation.metrics import align
from dpm2_core.extras import needs
from dpm2_core.frame import Array, Frame, Points

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BACKGROUND, _INK, _ESTIMATE, _TRUTH = "#0d1117", "#c9d1d9", "#ff9f1c", "#ffffff"
_HEIGHTS = ("#3d4f8f", "#2f8f9d", "#7fd1ae", "#f6f3c0")  # ground to roofs
_PIXELS = 1100  # of the map raster along its longer side: about 0.15 m on a street, where voxels are 0.2 m
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
    figure = new_figure(
        figsize=(12, float(np.clip(12 * height / width, 3.5, 12)) + 0.8), dpi=150, facecolor=_BACKGROUND
    )
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.92), facecolor=_BACKGROUND, aspect="equal")
    axes.set_axis_off()
    if cloud is not None and len(cloud):
        axes.imshow(_raster(cloud, est[:, :3, 3], low, high), extent=(low[0], high[0], low[1], high[1]), origin="lower")
    if truth is not None:
        axes.plot(truth[:, 0], truth[:, 1], "--", color=_TRUTH, lw=1.2, label="ground truth (aligned)", zorder=4)
    axes.plot(est[:, 0, 3], est[:, 1, 3], color=_ESTIMATE, lw=3.0, label="estimate", zorder=3)
    axes.plot(*est[0, :2, 3], "o", color=_ESTIMATE, ms=8, mec=_BACKGROUND, label="start", zorder=5)
    axes.plot(*est[-1, :2, 3], "s", color=_ESTIMATE, ms=8, mec=_BACKGROUND, label="end", zorder=5)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.legend(loc="upper right", facecolor=_BACKGROUND, edgecolor="none", labelcolor=_INK, framealpha=0.7)
    _scale_bar(axes, low, high)
    figure.text(0.02, 0.955, title, color=_INK, fontsize=14)
    save_png(path, figure)


def trajectories_png(path: Path | str, ways: Mapping[str, Array], truth: Array | None = None, title: str = "") -> None:
    """Draw the ways (N, 3), m, of several methods and the true one from above, all in one frame.

    Raises:
        Dpm2Error: the file could not be written.
    """
    figure = new_figure(figsize=(9, 9), dpi=130, facecolor=_BACKGROUND)
    axes = figure.add_axes((0.07, 0.05, 0.9, 0.9), facecolor=_BACKGROUND, aspect="equal")
    if truth is not None:
        axes.plot(truth[:, 0], truth[:, 1], "--", color=_TRUTH, lw=1.5, label="ground truth", zorder=9)
    for name, way in ways.items():
        axes.plot(way[:, 0], way[:, 1], lw=1.5, label=name)
    axes.tick_params(colors=_INK)
    axes.set_xlabel("m", color=_INK)
    axes.legend(facecolor=_BACKGROUND, edgecolor="none", labelcolor=_INK)
    figure.text(0.07, 0.965, title, color=_INK, fontsize=13)
    save_png(path, figure)


def corrupted_png(path: Path | str, before: Frame, after: Frame, title: str = "") -> None:
    """Draw a frame as it is and as a failing sensor delivers it: the scan from above, and the image.

    Raises:
        Dpm2Error: the file could not be written.
    """
    rows = 2 if before.images else 1
    figure = new_figure(figsize=(12, 6.4 * rows - 3 * (rows - 1)), dpi=110, facecolor=_BACKGROUND)
    for column, frame in enumerate((before, after)):
        axes = figure.add_subplot(rows, 2, 1 + column, facecolor=_BACKGROUND, aspect="equal")
        axes.scatter(frame.points[:, 0], frame.points[:, 1], s=0.15, c=_ESTIMATE, linewidths=0)
        axes.set(xlim=(-40, 40), ylim=(-40, 40), xticks=[], yticks=[])
        if frame.images:
            axes = figure.add_subplot(rows, 2, 3 + column, facecolor=_BACKGROUND)
            axes.imshow(frame.images[0].pixels)
            axes.set_axis_off()
    figure.suptitle(title, color=_INK)
    save_png(path, figure)


def success_png(path: Path | str, kinds: Mapping[str, Mapping[str, Mapping[str, Any]]], title: str = "") -> None:
    """Bars of the fraction of pairs that each method registers, one group a kind of pair, with the median errors.

    Args:
        kinds: kind, method, and its figures `success` 0..1 and `median_m`, m (None where most have no result).

    Raises:
        Dpm2Error: the file could not be written.
    """
    rows = [(kind, method, figures) for kind, methods in kinds.items() for method, figures in methods.items()]
    figure = new_figure(figsize=(9, 0.36 * len(rows) + 1.4), dpi=120, facecolor=_BACKGROUND)
    axes = figure.add_axes((0.38, 0.12, 0.58, 0.8), facecolor=_BACKGROUND)
    for y, (_, method, figures) in enumerate(rows):
        axes.barh(y, 100 * figures["success"], color=_ESTIMATE if "with camera" in method else _HEIGHTS[0])
        median = figures["median_m"]
        message = "no result for most" if median is None else f"{median:.2f} m"
        axes.text(100 * figures["success"] + 1, y, message, color=_INK, va="center", fontsize=8)
    axes.set_yticks(range(len(rows)), [f"{kind}: {method}" for kind, method, _ in rows], color=_INK, fontsize=8)
    axes.set(xlim=(0, 115), ylim=(len(rows) - 0.4, -0.6))
    axes.set_xlabel("pairs registered, %; median error beside the bar", color=_INK)
    axes.tick_params(colors=_INK)
    figure.text(0.02, 0.95, title, color=_INK, fontsize=11)
    save_png(path, figure)


def lines_png(
    path: Path | str,
    panels: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float | None]]]],
    title: str = "",
) -> None:
    """Panels beside one another, each with a line a name.

    Args:
        panels: title of a panel, name of a line, and its values along x and y; None: a gap.

    Raises:
        Dpm2Error: the file could not be written.
    """
    rows = -(-len(panels) // 3)
    figure = new_figure(figsize=(15, 4.2 * rows + 0.6), dpi=100)
    for k, (name, lines) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(rows, min(3, len(panels)), k)
        for label, (x, y) in lines.items():
            axes.plot(x, np.array(y, float), marker=".", label=label)
        axes.set_title(name, fontsize=10)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=9)
    figure.suptitle(title)
    figure.tight_layout()
    save_png(path, figure)


def bars_png(path: Path | str, groups: Mapping[str, Mapping[str, float]], title: str = "") -> None:
    """Groups of bars, a color a name.

    Args:
        groups: name of a group, name of a bar, and its length; a group need not have every bar.

    Raises:
        Dpm2Error: the file could not be written.
    """
    names = list(dict.fromkeys(name for row in groups.values() for name in row))
    figure = new_figure(figsize=(9, 0.4 * len(groups) * len(names) / 2 + 1.6), dpi=100)
    axes = figure.add_subplot()
    for k, name in enumerate(names):
        at = np.arange(len(groups)) + (k - (len(names) - 1) / 2) * 0.8 / len(names)
        known = {y: row[name] for y, row in zip(at, groups.values(), strict=True) if name in row}
        axes.barh(list(known), list(known.values()), 0.8 / len(names), label=name)
        for y, length in known.items():
            axes.text(length, y, f" {length:.2f}", va="center", fontsize=8)
    axes.set_yticks(range(len(groups)), list(groups))
    axes.invert_yaxis()
    axes.set_title(title, fontsize=10)
    axes.legend()
    figure.tight_layout()
    save_png(path, figure)


_VERDICTS = {
    "right": ("#b7dfb0", "right"),
    "said": ("#f6df9a", "wrong, and says so"),
    "silent": ("#e79a92", "wrong, without a word"),
}


def verdicts_png(
    path: Path | str, panels: Mapping[str, Mapping[str, Mapping[str, tuple[str, float]]]], title: str = ""
) -> None:
    """Tables beside one another whose colors say at one look who was right, and who was wrong without a word.

    Args:
        panels: title of a table, name of a row, name of a column, and the verdict (`right`, `said`, `silent`) with the
            figure to write; rows are those of all tables.

    Raises:
        Dpm2Error: the file could not be written.
    """
    with needs("plot", "drawing"):
        from matplotlib.patches import Rectangle

    rows = list(dict.fromkeys(row for table in panels.values() for row in table))
    columns = list(dict.fromkeys(name for table in panels.values() for row in table.values() for name in row))
    figure = new_figure(figsize=(1.2 + 0.55 * len(columns) * len(panels), 0.24 * len(rows) + 1.7), dpi=120)
    for k, (name, table) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(1, len(panels), k)
        for row, cells in table.items():
            for column, (verdict, value) in cells.items():
                x, y = columns.index(column), rows.index(row)
                axes.add_patch(Rectangle((x, y), 0.96, 0.92, color=_VERDICTS[verdict][0]))
                axes.text(
                    x + 0.48,
                    y + 0.5,
                    f"{value:.2f}" if value < 9.95 else f"{value:.0f}",
                    ha="center",
                    va="center",
                    fontsize=7,
                )
        axes.set(xlim=(0, len(columns)), ylim=(len(rows), 0), xlabel=name)
        axes.set_xticks(np.arange(len(columns)) + 0.5, columns, fontsize=8, rotation=50, ha="left")
        axes.set_yticks(np.arange(len(rows)) + 0.5, rows if k == 1 else [""] * len(rows), fontsize=8)
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
    patches = [Rectangle((0, 0), 1, 1, color=color) for color, _ in _VERDICTS.values()]
    words = [meaning for _, meaning in _VERDICTS.values()]
    figure.legend(patches, words, loc="lower center", ncols=3, fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout(rect=(0, 0.05, 1, 1), w_pad=0.3)
    save_png(path, figure)


def _aligned(gt: Array, est: Array) -> Array | None:
    """Known positions of the ground truth (K, 3) in the map frame; None with fewer than two in common."""
    has_gt, common = known(gt), known(gt) & known(est)
    if common.sum() < 2:
        return None
    T_map_gt = align(gt[common, :3, 3], est[common, :3, 3])
    return gt[has_gt, :3, 3] @ T_map_gt[:3, :3].T + T_map_gt[:3, 3]


def _bounds(positions: Array, cloud: Points | None) -> tuple[Array, Array]:
    """Corners (2,), (2,) of what is shown: the trajectory with a margin, which the map may cut to where points are."""
    low, high = positions[:, :2].min(0) - _MARGIN, positions[:, :2].max(0) + _MARGIN
    if cloud is not None and len(cloud):
        reach = 3.0
        low = np.maximum(low, np.minimum(np.percentile(cloud[:, :2], 0.5, axis=0), positions[:, :2].min(0)) - reach)
        high = np.minimum(high, np.maximum(np.percentile(cloud[:, :2], 99.5, axis=0), positions[:, :2].max(0)) + reach)
    return low, high


def _raster(cloud: Points, positions: Array, low: Array, high: Array) -> NDArray[np.float64]:
    """(H, W, 3) image of the points: hue from the highest in each pixel, brightness from how many there are.

    Heights count from the nearest of the (N, 3) positions of the LiDAR: a street on a hill must not outshine houses
    in the valley. Pixels are no finer than the spacing of the points, so that surfaces look like surfaces.
    """
    with needs("plot", "drawing"):
        from matplotlib.colors import LinearSegmentedColormap, to_rgb

    cloud = cloud[np.logical_and.reduce((cloud[:, :2] > low) & (cloud[:, :2] < high), axis=1), :3]
    if not len(cloud):
        return np.full((1, 1, 3), to_rgb(_BACKGROUND))
    nearest = KDTree(cloud).query(cloud[:: len(cloud) // 2000 + 1], k=[2])[0]
    pixel = max((high - low).max() / _PIXELS, np.median(np.minimum(nearest, 1.0)))  # inf for a single point
    width, height = np.ceil((high - low) / pixel).astype(int)
    x, y = ((cloud[:, :2] - low) / pixel).astype(int).T
    z = cloud[:, 2] - positions[KDTree(positions[:, :2]).query(cloud[:, :2])[1], 2]
    cell = np.minimum(y, height - 1) * width + np.minimum(x, width - 1)
    count = np.bincount(cell, minlength=width * height)
    top = np.full(width * height, -np.inf)
    np.maximum.at(top, cell, z)
    bottom, ceiling = np.percentile(z, [3, 95])
    heights = LinearSegmentedColormap.from_list("heights", _HEIGHTS)
    hue = heights(np.clip((top - bottom) / max(ceiling - bottom, 1e-3), 0, 1))[:, :3]
    strength = np.where(count > 0, 0.4 + 0.6 * np.clip(np.log1p(count) / np.log(6), 0, 1), 0.0)[:, None]
    return (np.array(to_rgb(_BACKGROUND)) * (1 - strength) + hue * strength).reshape(height, width, 3)


def _scale_bar(axes: Axes, low: Array, high: Array) -> None:
    """A bar of 1, 2 or 5 times a power of ten meters, about a sixth of the width."""
    width = high[0] - low[0]
    decade = 10.0 ** np.floor(np.log10(width / 6))
    length = decade * max(step for step in (1, 2, 5) if step * decade <= width / 6)
    x, y = low + 0.03 * width
    axes.plot([x, x + length], [y, y], color=_INK, lw=3, solid_capstyle="butt", zorder=5)
    axes.text(x + length / 2, y + 0.008 * width, f"{length:g} m", color=_INK, ha="center", va="bottom", zorder=5)
