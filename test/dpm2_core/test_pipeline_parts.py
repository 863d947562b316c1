# SPDX-License-Identifier: Apache-2.0
"""Runs over recordings whose clouds are parts of a sweep."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.config import load_settings
from dpm2_core.data.sweep_parts import whole_sweeps
from dpm2_core.errors import UsageError
from dpm2_core.estimates import BETWEEN
from dpm2_core.frame import Frame
from dpm2_core.learning.finetune_data import _cut, refer
from dpm2_core.learning.generate import pack
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.session import MapMode
from dpm2_core.slam.settings import Config

from ..helpers.drives import InMemory, in_parts, make_drive
from ..helpers.networks import tiny

CONFIG = load_settings(Config, None, ["slam.loops.enabled=false"])


@pytest.fixture(scope="module")
def parts() -> list[Frame]:
    return in_parts(make_drive("city", 10, deskewed=False)[0])


def test_a_run_goes_on_where_its_map_ends(parts: list[Frame], tmp_path: Path) -> None:
    """The map ends with a sweep, and the frame of that number is only its last part: it was not recognized."""
    runs: list[tuple[MapMode, int | None, int]] = [("create", 75, 75), ("resume", None, 41)]
    for mode, end, scans in runs:
        with OfflineRun(InMemory(parts), CONFIG, (0, end), map_file=tmp_path / "map", map_mode=mode) as run:
            result = run.run()
            result.save(tmp_path / mode)
        assert len(result) == scans
        assert result.methods[BETWEEN] >= 0.8 * scans
        assert result.methods["failed"] == 0
    mirrored = [replace(frame, points=frame.points * np.array([1, -1, 1, 1], np.float32)) for frame in parts]
    with pytest.raises(UsageError, match="not the one with which the map ends"):
        OfflineRun(InMemory(mirrored), CONFIG, map_file=tmp_path / "map", map_mode="resume")


@pytest.mark.parametrize("every", [1, 20])
def test_sweeps_are_packed_not_their_parts(parts: list[Frame], tmp_path: Path, every: int) -> None:
    """Each part was a sample of its own, a tenth of a sweep; with `--every`, of each so many frames."""
    source = InMemory(parts)
    source.poses = np.tile(np.eye(4), (len(parts), 1, 1))
    assert pack(source, tmp_path / "all", tiny(), range(0, len(parts), every)) == 10 * 10 // max(every, 10)
    sizes = [len(cloud.points) for _, cloud in whole_sweeps(parts)]
    assert min(sizes) > 5 * max(len(one.points) for one in parts)


def test_the_parts_of_a_fine_tuning_begin_with_a_sweep(parts: list[Frame], tmp_path: Path) -> None:
    """Those of the held-out part were joined to other sweeps than the SLAM's, which have no pose."""
    referenced = refer(InMemory(parts), CONFIG.slam)
    cut = _cut(referenced, 0.35)
    assert cut == 60
    assert pack(referenced, tmp_path / "drive", tiny(), range(cut)) == 6
    assert pack(referenced, tmp_path / "held out", tiny(), range(cut, 100)) == 4
