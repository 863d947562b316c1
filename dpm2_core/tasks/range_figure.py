# SPDX-License-Identifier: Apache-2.0
"""Images of range images: each as it is, and its points seen from above."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dpm2_core.evaluation.canvas import BACKGROUND, INK, new_figure, save_png
from dpm2_core.tasks.range_scans import RangeScans

_FAR = 40.0  # m, the last color, and the edge of the view from above


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
        flat = figure.add_axes((0.01, bottom + 0.15 * height, 0.7, 0.7 * height), facecolor="black")
        d = np.where(scans.masks[0].cpu().numpy(), scans.images[0, 0].cpu().numpy() * scans.scale, np.nan)
        half = d.shape[1] // 2
        flat.imshow(np.roll(d, half, 1)[:, ::-1], aspect="auto", vmin=0, vmax=_FAR, cmap="turbo")  # ahead in the middle
        flat.set_title(name, color=INK, loc="left", fontsize=11)
        flat.set(xticks=[], yticks=[])
        above = figure.add_axes((0.73, bottom + 0.02, 0.26, height - 0.04), facecolor="black", aspect="equal")
        points = scans.clouds()[0].cpu().numpy()
        order = np.argsort(points[:, 2])
        above.scatter(
            points[order, 0], points[order, 1], c=points[order, 2], s=0.6, cmap="viridis", vmin=-2, vmax=2, lw=0
        )
        above.set(xlim=(-_FAR, _FAR), ylim=(-_FAR, _FAR), xticks=[], yticks=[])
    save_png(path, figure)
