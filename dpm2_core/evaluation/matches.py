# SPDX-License-Identifier: Apache-2.0
"""Drawing of a registration: the matched descriptors of two scans, their confidence, and the result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from dpm2_core.evaluation.canvas import BACKGROUND, ESTIMATE, INK, new_figure
from dpm2_core.evaluation.image_attention import ImageAttention, draw_attention
from dpm2_core.extras import needs
from dpm2_core.files import atomic_write
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TARGET_COLOR, _SOURCE_COLOR = "#3f7fbf", ESTIMATE
_VIEW_RANGE = 50.0  # m of each scan that is drawn around its sensor


def matches_png(
    path: Path | str,
    network: DeepPointMap2,
    source: Frame,
    target: Frame,
    title: str = "",
    attention: ImageAttention | None = None,
) -> None:
    """Draw how a network registers a scan to another, in two views from above: the scans next to each other with their
    matches, and one on top of the other.

    Args:
        attention: drawn on the source's image; None: no image.

    Raises:
        Dpm2Error: too few points, or the file could not be written.
    """
    compared_png(path, [(title, network, attention)], source, target)


def compared_png(
    path: Path | str,
    networks: Sequence[tuple[str, DeepPointMap2, ImageAttention | None]],
    source: Frame,
    target: Frame,
) -> None:
    """`matches_png` of several networks, one below the other.

    Args:
        networks: title, network, and attention to draw on the image or None, of each.

    Raises:
        Dpm2Error: too few points, or the file could not be written.
    """
    with needs("plot", "drawing"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg

    images = []
    for title, network, attention in networks:
        canvas = FigureCanvasAgg(_figure(network, source, target, title, attention))
        canvas.draw()
        images.append(np.asarray(canvas.buffer_rgba())[:, :, 2::-1])  # BGR
    with atomic_write(path, "wb") as file:
        file.write(cv2.imencode(".png", np.vstack(images))[1].tobytes())  # all are equally wide


def _figure(
    network: DeepPointMap2, source: Frame, target: Frame, title: str, attention: ImageAttention | None
) -> Figure:
    source_descriptors, target_descriptors = network.describe(source), network.describe(target)
    result = network.register(source_descriptors, target_descriptors)
    source_points, target_points, confidence = network.matches(source_descriptors, target_descriptors)
    with needs("plot", "drawing"):
        from matplotlib.collections import LineCollection  # half a second to import: not for every command

    attention_height = 0.0 if attention is None else 0.43  # the image's fraction of the height, below the scans
    figure = new_figure(figsize=(18, 7.2 / (1 - attention_height)), dpi=110, facecolor=BACKGROUND)

    def axes_box(left: float, width: float) -> tuple[float, float, float, float]:
        return left, attention_height + 0.02 * (1 - attention_height), width, 0.88 * (1 - attention_height)

    matches_axes = figure.add_axes(axes_box(0.01, 0.63), facecolor=BACKGROUND, aspect="equal")
    overlay_axes = figure.add_axes(axes_box(0.66, 0.33), facecolor=BACKGROUND, aspect="equal")
    if attention is not None:
        draw_attention(figure.add_axes((0.02, 0.01, 0.96, attention_height - 0.04), facecolor=BACKGROUND), attention)
    source_shift = np.array([2.1 * _VIEW_RANGE, 0.0])
    for axes, points, shift, color in (
        (matches_axes, target.points, np.zeros(2), _TARGET_COLOR),
        (matches_axes, source.points, source_shift, _SOURCE_COLOR),
        (overlay_axes, target.points, np.zeros(2), _TARGET_COLOR),
        (overlay_axes, se3.transform(result.T_target_source, source.points), np.zeros(2), _SOURCE_COLOR),
    ):
        near = points[np.abs(points[:, :2]).max(1) < _VIEW_RANGE]
        axes.plot(*(near[:, :2] + shift).T, ",", color=color, alpha=0.6)
        axes.set_axis_off()
    order = np.argsort(confidence)  # the most confident on top
    ends = np.stack([target_points[order, :2], source_points[order, :2] + source_shift], 1)
    lines = LineCollection(list(ends), array=confidence[order], cmap="viridis", linewidths=0.8, clim=(0, 1))
    matches_axes.add_collection(lines)
    for column in (0, 1):
        matches_axes.scatter(
            ends[:, column, 0], ends[:, column, 1], c=confidence[order], cmap="viridis", vmin=0, vmax=1, s=9, zorder=3
        )
    matches_axes.set(xlim=(-_VIEW_RANGE, source_shift[0] + _VIEW_RANGE), ylim=(-_VIEW_RANGE, _VIEW_RANGE))
    overlay_axes.set(xlim=(-_VIEW_RANGE, _VIEW_RANGE), ylim=(-_VIEW_RANGE, _VIEW_RANGE))
    bar = figure.colorbar(lines, ax=matches_axes, fraction=0.02, pad=0.01)
    bar.set_label("confidence of a match", color=INK)
    bar.ax.tick_params(colors=INK)
    meters, degrees = se3.magnitude(result.T_target_source)
    outcome = (
        f"{meters:.2f} m, {degrees:.2f} deg apart; confidence {result.confidence:.2f}, rmse {result.rmse:.2f} m"
        if result.ok
        else f"not registered: {result.reason}"
    )
    figure.text(0.02, attention_height + 0.945 * (1 - attention_height), f"{title}: {outcome}", color=INK, fontsize=13)
    return figure
