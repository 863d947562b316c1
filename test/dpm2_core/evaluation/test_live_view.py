# SPDX-License-Identifier: Apache-2.0
"""What a run shows, read from its recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.estimates import BETWEEN, OdometryResult, Registration, State
from dpm2_core.evaluation.live_view import LiveView
from dpm2_core.frame import NO_POINTS, Frame
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.system import SlamResult

from ...helpers.command import dpm2
from ...helpers.drives import first_scans

_SETTINGS = ("slam.registration=geometric", "slam.loops.descriptors=false", "slam.visual.enabled=false")
FAST = tuple(part for pair in _SETTINGS for part in ("--set", pair))
FRAMES = 9


def test_a_view_that_is_of_no_use_is_rejected(tmp_path: Path) -> None:
    done = dpm2("run", ".", "--out", tmp_path, "--localise", "m", "--record", tmp_path / "run.rrd")
    assert done.returncode == 2
    assert "--record" in done.stderr


@pytest.fixture(scope="module")
def recorded(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded run of 9 frames."""
    pytest.importorskip("rerun", reason="no rerun: pip install '.[view]'")
    folder = tmp_path_factory.mktemp("view")
    drive = first_scans(recording, FRAMES, folder / "drive")
    done = dpm2("run", drive, "--out", folder / "out", "--record", folder / "run.rrd", *FAST)
    assert done.returncode == 0, done.stderr
    return folder / "run.rrd"


def test_without_a_display_a_view_is_an_error_at_once(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A view without a display is an error. Previously, Rerun reported nothing, and the run never ended."""
    pytest.importorskip("rerun", reason="no rerun: pip install '.[view]'")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = dpm2("run", str(recording), "--out", str(tmp_path / "out"), "--view", "--frames", "0:3")
    assert done.returncode == 1
    assert "no display for rerun's viewer" in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_figures_are_those_of_whole_sweeps(tmp_path: Path) -> None:
    """A part that completes no sweep has no times but the map's, which were drawn as if they were another stage's."""
    pytest.importorskip("rerun", reason="no rerun: pip install '.[view]'")
    mapper, found = make_mapper(SlamSettings()), Registration(np.eye(4), np.eye(6), method="geometric")
    with LiveView("parts", False, tmp_path / "run.rrd") as view:
        for i in range(20):
            result = found if i % 10 == 9 else replace(found, method=BETWEEN, ok=False)
            tracked = OdometryResult(
                i, i, np.eye(4), np.eye(6), np.zeros(6), State.TRACKING, result, seconds={"map": 0}
            )
            view.add(Frame(i, NO_POINTS, index=i), SlamResult(tracked, None, np.eye(4), State.TRACKING), mapper)
    names = entities(tmp_path / "run.rrd")
    assert names["/map/lidar"] == 20
    assert names["/times"] == 3  # with the names of the stages


@pytest.mark.slow
def test_the_recording_has_the_pose_of_every_frame_the_map_and_the_figures(recorded: Path) -> None:
    names = entities(recorded)
    assert {"/map/lidar", "/map/lidar/scan", "/map/way", "/map/keyframes/0/cloud"} <= set(names)
    assert names["/map/lidar"] == FRAMES
    assert min(names["/times"], names["/quality"]) >= FRAMES


@pytest.mark.slow
def test_a_recording_that_cannot_be_written_is_said_before_the_run(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="no rerun: pip install '.[view]'")
    done = dpm2("run", recording, "--out", tmp_path / "out", "--record", tmp_path / "no" / "run.rrd", *FAST)
    assert done.returncode == 2
    assert "no such folder" in done.stderr
    assert not (tmp_path / "out").exists()


def entities(path: Path) -> dict[str, int]:
    """Number of rows of each entity in a recording."""
    from rerun.chunk import RrdReader

    counts: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        counts[chunk.entity_path] = counts.get(chunk.entity_path, 0) + chunk.num_rows
    return counts
