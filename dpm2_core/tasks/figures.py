# SPDX-License-Identifier: Apache-2.0
"""Images of the results of the tasks' networks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.evaluation.canvas import BACKGROUND, INK, new_figure, save_png
from dpm2_core.network.perception.gndnet import GroundSettings, cell_of, height_above
from dpm2_core.tasks.range_scans import RangeScans

_MAX_DISTANCE = 40.0  # m, the last color of a range image, and the edge of the view from above


def dynamic_objects_png(
    path: Path, points: NDArray[np.float32], found: NDArray[np.bool_], truth: NDArray[np.bool_]
) -> None:
    """Draw points (N, 3+) from above, x upwards: dynamic objects as found (N,) and as true (N,).

    Raises:
        Dpm2Error: the file could not be written.
    """
    figure = new_figure(figsize=(8, 8), dpi=120, layout="constrained")
    axes = figure.subplots()
    kinds = (
        (~found & ~truth, "standing", "0.7"),
        (found & truth, "dynamic object, found", "tab:green"),
        (~found & truth, "dynamic object, missed", "tab:red"),
        (found & ~truth, "static, wrongly found", "tab:blue"),
    )
    for mask, name, color in kinds:
        axes.plot(points[mask, 1], points[mask, 0], ".", ms=1, mew=0, color=color, label=f"{name}: {mask.sum()}")
    axes.set(xlim=(40, -40), ylim=(-40, 40), xlabel="y, m", ylabel="x (ahead), m", aspect="equal")
    axes.legend(markerscale=12, loc="upper right")
    save_png(path, figure)


def ground_png(path: Path, found: Tensor, truth: Tensor, points: Tensor, settings: GroundSettings) -> None:
    """Draw the elevation (cells, cells) found, that of the labels (NaN where unknown) and their difference, x upwards.

    The first one shows the points (N, 4) above it.

    Raises:
        Dpm2Error: the file could not be written.
    """
    is_above = (height_above(points, found, settings) > settings.threshold) & cell_of(points, settings)[1]
    half = settings.cells * settings.cell / 2
    seen = truth[truth.isfinite()].cpu().numpy()
    low, high = (
        np.percentile(seen, [1, 99]) if len(seen) else (-settings.sensor_height - 1, -settings.sensor_height + 1)
    )
    figure = new_figure(figsize=(15, 5), dpi=120, layout="constrained")
    views = (("elevation found, points above it", found, (low, high), "viridis"),
             ("elevation of the labels", truth, (low, high), "viridis"),
             ("found - labels", found - truth, (-0.3, 0.3), "RdBu"))  # fmt: skip
    for axes, (title, grid, (lowest, highest), colors) in zip(figure.subplots(1, 3), views, strict=True):
        image = axes.imshow(
            grid.cpu().numpy(),
            extent=(-half, half, -half, half),
            origin="lower",
            vmin=lowest,
            vmax=highest,
            cmap=colors,
        )
        figure.colorbar(image, ax=axes, label="m", shrink=0.8)
        axes.set(title=title, xlabel="y, m", xlim=(half, -half), ylim=(-half, half))
        axes.set_ylabel("x (ahead), m")
        if grid is found:
            xy = points[is_above, :2].cpu().numpy()
            axes.plot(xy[:, 1], xy[:, 0], ",", color="crimson", alpha=0.4)
    save_png(path, figure)


def range_png(path: Path, rows: Mapping[str, RangeScans], title: str) -> None:
    """Draw range images below each other, colored by distance, black where a slot is empty.

    Args:
        rows: name and scan; of several the first is drawn.

    Raises:
        Dpm2Error: the file could not be written.
    """
    figure = new_figure(figsize=(14, 3.4 * len(rows) + 0.6), dpi=90, facecolor=BACKGROUND)
    figure.text(0.01, 1 - 0.3 / (3.4 * len(rows) + 0.6), title, color=INK, fontsize=13, va="center")
    for k, (name, scans) in enumerate(rows.items()):
        bottom, height = (len(rows) - 1 - k) / len(rows) * 0.94, 0.94 / len(rows)
        image_axes = figure.add_axes((0.01, bottom + 0.15 * height, 0.7, 0.7 * height), facecolor="black")
        d = np.where(scans.masks[0].cpu().numpy(), scans.images[0, 0].cpu().numpy() * scans.scale, np.nan)
        half = d.shape[1] // 2
        image_axes.imshow(
            np.roll(d, half, 1)[:, ::-1], aspect="auto", vmin=0, vmax=_MAX_DISTANCE, cmap="turbo"
        )  # ahead in the middle
        image_axes.set_title(name, color=INK, loc="left", fontsize=11)
        image_axes.set(xticks=[], yticks=[])
        top_axes = figure.add_axes((0.73, bottom + 0.02, 0.26, height - 0.04), facecolor="black", aspect="equal")
        points = scans.clouds()[0].cpu().numpy()
        order = np.argsort(points[:, 2])
        top_axes.scatter(
            points[order, 0], points[order, 1], c=points[order, 2], s=0.6, cmap="viridis", vmin=-2, vmax=2, lw=0
        )
        top_axes.set(xlim=(-_MAX_DISTANCE, _MAX_DISTANCE), ylim=(-_MAX_DISTANCE, _MAX_DISTANCE), xticks=[], yticks=[])
    save_png(path, figure)
