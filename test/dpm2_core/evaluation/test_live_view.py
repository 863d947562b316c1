# SPDX-License-Identifier: Apache-2.0
"""What a run shows, read from its recording."""

from __future__ import annotations

from pathlib import Path

import pytest

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
