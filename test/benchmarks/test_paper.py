# SPDX-License-Identifier: Apache-2.0
"""The paper's methods in our configuration: each one changes the settings, and together they are the preset."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper import WAYS, lap
from dpm2_core.commands.bench import bench
from dpm2_core.config import load_settings
from dpm2_core.slam.settings import Config


def test_each_way_is_a_part_of_the_preset() -> None:
    ours, paper = (load_settings(Config, None, WAYS[name]).slam.model_dump() for name in ("ours", "the paper's"))
    changed = set()
    for name in set(WAYS) - {"the paper's"}:
        one = load_settings(Config, None, WAYS[name]).slam.model_dump()
        for part, values in one.items():
            for key, value in values.items() if isinstance(values, dict) else ():
                if value != ours[part][key]:
                    changed.add((part, key))
                    assert value == paper[part][key], (name, part, key)
    differing = {
        (part, key) for part, values in paper.items() if isinstance(values, dict)
        for key, value in values.items() if value != ours[part][key]
    }  # fmt: skip
    assert changed == differing


@pytest.mark.slow
def test_the_simulated_drive_is_of_every_second_scan_of_a_good_lap() -> None:
    """The drive has as many scans as poses. Previously, it had the length of the whole drive, although no scan of the
    second half exists."""
    drive = lap()
    assert len(drive) == len(drive.poses)
    (last,) = drive.frames(len(drive) - 1)
    assert last.index == len(drive) - 1
    back = np.linalg.norm(drive.poses[:, :3, 3] - drive.poses[0, :3, 3], axis=1)
    assert back.max() > 50
    assert back[len(back) // 2 :].min() < 10  # m: it returns to its start


@pytest.mark.slow
def test_an_excerpt_keeps_the_numbers_of_its_scans(recording: Path, tmp_path: Path) -> None:
    whole = recording / "sequences" / "00"
    excerpt = tmp_path / "00"
    (excerpt / "velodyne").mkdir(parents=True)
    shutil.copy(whole / "calib.txt", excerpt)
    scans = sorted((whole / "velodyne").iterdir())[20:24]
    for scan in scans:
        shutil.copy(scan, excerpt / "velodyne")
    truth = whole / "poses.txt" if (whole / "poses.txt").is_file() else recording / "poses" / "00.txt"
    np.savetxt(excerpt / "poses.txt", np.loadtxt(truth)[20:24])
    bench(["paper"], source=[excerpt], out=tmp_path, only="ours", threads=1)
    (row,) = json.loads((tmp_path / "paper.json").read_text())["drives"]["00"].values()
    assert (row["frames"], row["failed_frames"]) == (4, 0)
    assert row["rpe_trans_m"] < 0.05  # a street without moving objects
