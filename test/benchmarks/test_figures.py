# SPDX-License-Identifier: Apache-2.0
"""The plots of the benchmarks show their data."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import verdicts_png


def test_verdicts_have_the_colors_of_their_meaning(tmp_path: Path) -> None:
    """One cell each of right, said and silent: the red of `silent` is in the image only if that verdict is present."""

    def reds(verdict: str) -> int:
        panels = {"00": {"gap": {"ours": ("right", 0.1), "theirs": (verdict, 12.0)}}, "04": {"blind": {}}}
        verdicts_png(tmp_path / "verdicts.png", panels)
        picture = cv2.imread(str(tmp_path / "verdicts.png"))[:, :, ::-1].astype(int)
        return int((np.abs(picture - [231, 154, 146]).max(-1) < 6).sum())

    legend = reds("said")
    assert reds("silent") > legend + 500
