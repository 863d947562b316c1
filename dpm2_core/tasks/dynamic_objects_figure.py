# SPDX-License-Identifier: Apache-2.0
"""Image of the dynamic objects in a scan: what was found, what was missed, what was taken for one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.evaluation.canvas import new_figure, save_png


def dynamic_objects_png(
    path: Path, points: NDArray[np.float32], found: NDArray[np.bool_], truth: NDArray[np.bool_]
) -> None:
    """Points (N, 3+) from above, x upwards, with what was found to be a dynamic object (N,) and what is one (N,).

    Raises:
        Dpm2Error: the file could not be written.
    """
    figure = new_figure(figsize=(8, 8), dpi=120, layout="constrained")
    axes = figure.subplots()
    kinds = (
        (~found & ~truth, "standing", "0.7"),
        (found & truth, "dynamic object, found", "tab:green"),
        (~found & truth, "dynamic object, missed", "tab:red"),
        (found & ~truth, "standing, taken for one", "tab:blue"),
    )
    for which, name, color in kinds:
        axes.plot(points[which, 1], points[which, 0], ".", ms=1, mew=0, color=color, label=f"{name}: {which.sum()}")
    axes.set(xlim=(40, -40), ylim=(-40, 40), xlabel="y, m", ylabel="x (ahead), m", aspect="equal")
    axes.legend(markerscale=12, loc="upper right")
    save_png(path, figure)
