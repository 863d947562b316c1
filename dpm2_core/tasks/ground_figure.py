# SPDX-License-Identifier: Apache-2.0
"""Images of what the tasks' networks make of a scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from dpm2_core.evaluation.canvas import new_figure, save_png
from dpm2_core.network.perception.gndnet import GroundSettings, cell_of, height_above


def ground_png(path: Path, found: Tensor, truth: Tensor, points: Tensor, settings: GroundSettings) -> None:
    """Elevation (cells, cells) found, that of the labels (NaN where unknown) and their difference, x upwards.

    On the first, the points (N, 4) that stand above it.

    Raises:
        Dpm2Error: the file could not be written.
    """
    above = (height_above(points, found, settings) > settings.threshold) & cell_of(points, settings)[1]
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
            xy = points[above, :2].cpu().numpy()
            axes.plot(xy[:, 1], xy[:, 0], ",", color="crimson", alpha=0.4)
    save_png(path, figure)
