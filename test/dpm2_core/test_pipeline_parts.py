# SPDX-License-Identifier: Apache-2.0
"""Runs over recordings whose clouds are parts of a sweep."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.config import load_settings
from dpm2_core.errors import UsageError
from dpm2_core.estimates import BETWEEN
from dpm2_core.frame import Frame
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.settings import Config

from ..helpers.drives import InMemory, in_parts, make_drive

CONFIG = load_settings(Config, None, ["slam.loops.enabled=false"])


@pytest.fixture(scope="module")
def parts() -> list[Frame]:
    return in_parts(make_drive("city", 10, deskewed=False)[0])


def test_a_run_goes_on_where_its_map_ends(parts: list[Frame], tmp_path: Path) -> None:
    """The map ends with a sweep, and the frame of that number is only its last part: it was not recognized."""
    for mode, end, scans in (("create", 75, 75), ("resume", None, 41)):
        with OfflineRun(InMemory(parts), CONFIG, (0, end), map_file=tmp_path / "map", map_mode=mode) as run:
            result = run.run()
            result.save(tmp_path / mode)
        assert len(result) == scans
        assert result.methods[BETWEEN] >= 0.8 * scans
        assert result.methods["failed"] == 0
    mirrored = [replace(frame, points=frame.points * np.float32([1, -1, 1, 1])) for frame in parts]
    with pytest.raises(UsageError, match="not the one with which the map ends"):
        OfflineRun(InMemory(mirrored), CONFIG, map_file=tmp_path / "map", map_mode="resume")
