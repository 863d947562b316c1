# SPDX-License-Identifier: Apache-2.0
"""Plots of the benchmarks: success rates on pairs, lines, bars, and tables with colors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.evaluation.canvas import BACKGROUND, INK, new_figure, save_png
from dpm2_core.extras import needs

_WITH_CAMERA, _WITHOUT = "#ff9f1c", "#3d4f8f"
_VERDICTS = {
    "right": ("#b7dfb0", "right"),
    "said": ("#f6df9a", "wrong, and says so"),
    "silent": ("#e79a92", "wrong, without a word"),
}


def success_png(path: Path | str, kinds: Mapping[str, Mapping[str, Mapping[str, Any]]], title: str = "") -> None:
    """Bars of the fraction of pairs that each method registers, grouped by kind of pair, with the median errors.

    Args:
        kinds: kind, method, and its figures `success` 0..1 and `median_m`, m (None if most pairs have no result).

    Raises:
        Dpm2Error: the file could not be written.
    """
    rows = [(kind, method, figures) for kind, methods in kinds.items() for method, figures in methods.items()]
    figure = new_figure(figsize=(9, 0.36 * len(rows) + 1.4), dpi=120, facecolor=BACKGROUND)
    axes = figure.add_axes((0.38, 0.12, 0.58, 0.8), facecolor=BACKGROUND)
    for y, (_, method, figures) in enumerate(rows):
        axes.barh(y, 100 * figures["success"], color=_WITH_CAMERA if "with camera" in method else _WITHOUT)
        median = figures["median_m"]
        message = "no result for most" if median is None else f"{median:.2f} m"
        axes.text(100 * figures["success"] + 1, y, message, color=INK, va="center", fontsize=8)
    axes.set_yticks(range(len(rows)), [f"{kind}: {method}" for kind, method, _ in rows], color=INK, fontsize=8)
    axes.set(xlim=(0, 115), ylim=(len(rows) - 0.4, -0.6))
    axes.set_xlabel("pairs registered, %; median error beside the bar", color=INK)
    axes.tick_params(colors=INK)
    figure.text(0.02, 0.95, title, color=INK, fontsize=11)
    save_png(path, figure)


def lines_png(
    path: Path | str,
    panels: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float | None]]]],
    title: str = "",
) -> None:
    """Panels side by side, each with one line per name.

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
    """Groups of bars, with one color per name.

    Args:
        groups: name of a group, name of a bar, and its length; a group need not have every bar.

    Raises:
        Dpm2Error: the file could not be written.
    """
    names = list(dict.fromkeys(name for row in groups.values() for name in row))
    figure = new_figure(figsize=(9, 0.4 * len(groups) * len(names) / 2 + 1.6), dpi=100)
    axes = figure.add_subplot()
    for k, name in enumerate(names):
        positions = np.arange(len(groups)) + (k - (len(names) - 1) / 2) * 0.8 / len(names)
        lengths = {y: row[name] for y, row in zip(positions, groups.values(), strict=True) if name in row}
        axes.barh(list(lengths), list(lengths.values()), 0.8 / len(names), label=name)
        for y, length in lengths.items():
            axes.text(length, y, f" {length:.2f}", va="center", fontsize=8)
    axes.set_yticks(range(len(groups)), list(groups))
    axes.invert_yaxis()
    axes.set_title(title, fontsize=10)
    axes.legend()
    figure.tight_layout()
    save_png(path, figure)


def verdicts_png(
    path: Path | str, panels: Mapping[str, Mapping[str, Mapping[str, tuple[str, float]]]], title: str = ""
) -> None:
    """Tables side by side; the colors show which methods were right, and which were wrong without reporting it.

    Args:
        panels: title of a table, name of a row, name of a column, and the verdict (`right`, `said`, `silent`) with the
            figure to write; the rows are those of all tables.

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
