# SPDX-License-Identifier: Apache-2.0
"""matplotlib without a window: a new figure, a figure as a file, and the common colors of the images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from dpm2_core.extras import needs
from dpm2_core.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BACKGROUND, INK, ESTIMATE = "#0d1117", "#c9d1d9", "#ff9f1c"
"""Dark background, text on it, and the estimate."""


def new_figure(**attributes: Any) -> Figure:
    """An empty figure, with attributes of matplotlib's `Figure`.

    Raises:
        MissingPackageError: the extra `plot` is not installed.
    """
    with needs("plot", "drawing"):
        from matplotlib.figure import Figure  # half a second to import: not for every command

    return Figure(**attributes)


def save_png(path: Path | str, figure: Figure) -> None:
    """Write a figure, completely or not at all.

    Raises:
        Dpm2Error: the file could not be written.
    """
    with needs("plot", "drawing"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg

    with atomic_write(path, "wb") as file:
        FigureCanvasAgg(figure).print_png(file)
