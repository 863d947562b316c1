# SPDX-License-Identifier: Apache-2.0
"""The files of a run are read back as written; missing ones are left out, damaged ones are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.trajectory import write_tum
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Edge, Registration
from dpm2_core.evaluation.run_folder import (
    FRAMES,
    LOOPS,
    TRAJECTORY,
    TRUTH,
    read_run,
    set_aside,
    write_frames,
    write_loops,
    write_truth,
)
from dpm2_core.geometry import se3

POSES = se3.exp(np.arange(4)[:, None] * np.array([0, 0, 0.1, 1.0, 0.2, 0]))
STAMPS = [10**18 + i * 10**8 for i in range(4)]


def test_frames_loops_and_truth_read_back(tmp_path: Path) -> None:
    """A reason may contain commas and quotes; an unknown true pose is left out."""
    write_tum(tmp_path / TRAJECTORY, STAMPS, POSES)
    keys = [(i, s, "tracking", "geometric") for i, s in enumerate(STAMPS)]
    write_frames(tmp_path / FRAMES, keys, {"register": [0.01, 0.02, 0.03, 0.04], "map": [0.0, 0.0, 0.5, 0.0]})
    refused = Registration(np.eye(4), np.eye(6), 0.1, np.inf, "neural", False, 'only 3 %, "too few"')
    loops = [Edge("loop", 0, 3, Registration(POSES[3], np.eye(6), method="points")), Edge("loop", 1, 3, refused)]
    write_loops(tmp_path / LOOPS, loops, POSES)
    truth = POSES.copy()
    truth[1] = np.nan
    write_truth(tmp_path / TRUTH, STAMPS, truth)
    run = read_run(tmp_path)
    assert run.trajectory.keys.tolist() == STAMPS
    assert run.states == ["tracking"] * 4
    np.testing.assert_allclose(run.stages_ms["map"], [0, 0, 500, 0])
    assert [(loop.accepted, loop.reason) for loop in run.loops] == [(True, ""), (False, 'only 3 %, "too few"')]
    np.testing.assert_allclose(run.loops[1].start, POSES[1, :3, 3], atol=1e-3)
    assert run.truth is not None
    assert run.truth.keys.tolist() == [STAMPS[0], *STAMPS[2:]]
    assert run.metrics == {}


def test_a_trajectory_alone_is_enough(tmp_path: Path) -> None:
    write_tum(tmp_path / TRAJECTORY, STAMPS, POSES)
    run = read_run(tmp_path)
    assert (run.states, run.loops, run.truth, run.stages_ms) == ([], [], None, {})


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        (LOOPS, "from_x,to_x\n1,2\n", "is damaged"),
        (FRAMES, "frame,stamp_ns,state,map_ms\n0,1,tracking,slow\n", "is damaged"),
        (FRAMES, "frame,stamp_ns,state,map_ms\n0,1,tracking,nan\n", "is damaged"),
        (FRAMES, f"frame,stamp_ns,state,map_ms\n0,1,{'x' * 200_000},1\n", "is damaged"),
        ("metrics.json", "{", "not JSON"),
        ("metrics.json", '{"ape_rmse_m": NaN}', "not JSON"),
        ("timing.json", "[1]", "want a mapping"),
        (TRUTH, "1 2 3\n", "3 numbers"),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, name: str, content: str, problem: str) -> None:
    write_tum(tmp_path / TRAJECTORY, STAMPS, POSES)
    (tmp_path / name).write_text(content)
    with pytest.raises(UsageError, match=problem):
        read_run(tmp_path)


def test_another_folder_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"not a folder of a run: no trajectory\.tum"):
        read_run(tmp_path)


def test_results_that_are_set_aside_again_replace_none(tmp_path: Path) -> None:
    """A run is resumed twice from one keyframe, as after Ctrl-C: the first results are the longest."""
    for count in (3, 1, 1):
        write_tum(tmp_path / "trajectory.tum", range(count), np.tile(np.eye(4), (count, 1, 1)))
        into = set_aside(tmp_path, "before_358")
        assert len(read_run(into).trajectory) == count
        assert not (tmp_path / "trajectory.tum").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["before_358", "before_358-2", "before_358-3"]
    assert len(read_run(tmp_path / "before_358").trajectory) == 3
