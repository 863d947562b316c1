# SPDX-License-Identifier: Apache-2.0
"""`dpm2 run --localise` as a user calls it: the drive is localized in the map, and no byte of the map changes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.geometry import se3
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore

from ...helpers.command import dpm2, refused, succeeded

pytestmark = [pytest.mark.slow, pytest.mark.weights]

MAPPED = 20
QUICK = ("--set", "slam.registration=geometric")
"""For the odometry from scan to scan: place recognition uses the network nevertheless."""


@pytest.fixture(scope="module")
def made(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of its first 20 scans, with the session's weights noted."""
    folder = tmp_path_factory.mktemp("map")
    path = folder / "drive.dpm2map"
    succeeded("run", recording, "--out", folder / "out", "--frames", f":{MAPPED}", "--map", path, *QUICK)
    with MapStore.open(path) as store:
        assert load_map(store).sessions[0].weights.startswith("small ")
    return path


def truth(recording: Path) -> np.ndarray:
    """(N, 4, 4) T_map_lidar: the map's frame is that of the first scan."""
    poses = open_source(recording, InputSettings(images=False)).poses
    return np.asarray(se3.inverse(poses[0]) @ poses)


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("hint", [None, "8,3,170"])
def test_the_drive_is_found_in_the_map_which_stays_as_it_is(
    recording: Path, made: Path, tmp_path: Path, hint: str | None, tiled: bool
) -> None:
    """It starts at scan 8 and continues to 4 m beyond the map, with a file or tiles of 10 m, for any heading of a
    hint."""
    before, map_ = hashlib.sha256(made.read_bytes()).hexdigest(), made
    if tiled:
        map_ = tmp_path / "tiles"
        succeeded("map", "export", made, map_, "--tiles", "10")
        assert len(list(map_.glob("*.dpm2map"))) > 1
    hints = [] if hint is None else ["--hint", hint]
    out = tmp_path / "out"
    out.mkdir()
    (out / "metrics.json").write_text("{}")  # left by a run that made a map
    done = succeeded("run", recording, "--out", out, "--frames", "8:24", "--localise", map_, *hints, *QUICK)
    assert hashlib.sha256(made.read_bytes()).hexdigest() == before
    assert sorted(path.name for path in made.parent.iterdir()) == ["drive.dpm2map", "out"]
    report = json.loads((out / "localisation.json").read_text())
    assert (report["frames"], report["frames_until_found"], report["kidnappings"]) == (16, 0, 0)
    estimate = read_trajectory(out / "trajectory.tum")
    assert len(estimate) == report["frames_located"] == 16
    off = np.linalg.norm(estimate.poses[:, :3, 3] - truth(recording)[8:24, :3, 3], axis=1)
    assert off.max() < 0.1
    assert "found after 0 frames" in done.stdout
    assert {path.name for path in out.iterdir()} == {"localisation.json", "trajectory.tum", "config.yaml"}


def test_a_tile_that_is_missing_costs_no_results(recording: Path, made: Path, tmp_path: Path) -> None:
    """Without a tile, the drive continues, and the exit code reports the problem to scripts, as for an incomplete map
    file. Previously, the drive ended there, with nothing in the folder."""
    assert dpm2("map", "export", made, tmp_path / "tiles", "--tiles", "100").returncode == 0
    missing = tmp_path / "tiles" / "0_0.dpm2map"
    missing.unlink()
    done = dpm2("run", recording, "--out", tmp_path / "o", "--frames", ":3", "--localise", tmp_path / "tiles", *QUICK)
    assert done.returncode == 1, done.stderr
    assert f"dpm2: parts of the map cannot be read: {missing}: no such map file" in done.stderr
    report = json.loads((tmp_path / "o" / "localisation.json").read_text())
    assert (report["frames"], report["map_unreadable"]) == (3, f"{missing}: no such map file")


def test_a_wrong_hint_only_costs_time(recording: Path, made: Path, tmp_path: Path) -> None:
    """Nothing is at the hint: after a second it searches everywhere, although the robot has hardly moved."""
    succeeded(
        "run", recording, "--out", tmp_path / "o", "--frames", ":13", "--localise", made, "--hint", "500,0,0", *QUICK
    )
    report = json.loads((tmp_path / "o" / "localisation.json").read_text())
    assert report["frames_until_found"] == 6  # the next keyframe, 5 m on
    assert report["frames_by_state"]["relocalising"] == 6
    assert len(read_trajectory(tmp_path / "o" / "trajectory.tum")) == 7


def test_kidnapping_is_noticed_and_answered(recording: Path, made: Path, tmp_path: Path) -> None:
    """The scans jump from the end of the map back to its start: lost for a while, never tracking at a wrong pose."""
    sequence = tmp_path / "sequence"
    (sequence / "velodyne").mkdir(parents=True)
    order = [*range(8, 19), *[1] * 24]
    for n, frame in enumerate(order):
        target = recording / "sequences" / "00" / "velodyne" / f"{frame:06d}.bin"
        (sequence / "velodyne" / f"{n:06d}.bin").symlink_to(target)
    (sequence / "times.txt").write_text("".join(f"{0.1 * n:.1f}\n" for n in range(len(order))))
    succeeded("run", sequence, "--out", tmp_path / "o", "--localise", made, *QUICK)
    report = json.loads((tmp_path / "o" / "localisation.json").read_text())
    assert [event["event"] for event in report["events"]].count("found") + report["kidnappings"] == 2
    estimate = read_trajectory(tmp_path / "o" / "trajectory.tum")
    where = np.round(estimate.keys * 1e-8).astype(int)
    T = truth(recording)[np.array(order)[where]]
    off = np.linalg.norm(estimate.poses[:, :3, 3] - T[:, :3, 3], axis=1)
    assert off[-1] < 0.3
    assert report["frames_by_state"]["lost"] > 0


def test_another_drive_extends_the_map_as_a_session_tied_by_loops(recording: Path, made: Path, tmp_path: Path) -> None:
    path = tmp_path / "grown.dpm2map"
    path.write_bytes(made.read_bytes())
    error = refused("run", recording, "--out", tmp_path / "o", "--frames", "4:", "--map", path)
    assert "--resume" in error
    done = succeeded("run", recording, "--out", tmp_path / "o", "--frames", "4:", "--map", path, "--extend", *QUICK)
    with MapStore.open(path) as store:
        data = load_map(store)
    assert {k.session for k in data.keyframes} == {1, 2}
    first = [k.session for k in data.keyframes].index(2)
    assert any(edge.from_node < first <= edge.to_node for edge in data.constraints), done.stderr
    at = {k.stamp: T for k, T in zip(data.keyframes[first:], data.poses[first:], strict=True)}
    last = max(at)
    expected = truth(recording)[round(last * 1e-8)]
    assert np.linalg.norm(at[last][:3, 3] - expected[:3, 3]) < 0.2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--localise", "/nowhere.dpm2map"], "/nowhere.dpm2map: no such map file"),
        (["--localise", "MAP", "--hint", "1,2"], "--hint 1,2: want x,y,yaw"),
        (["--localise", "MAP", "--hint", "1,2,nan"], "want finite numbers"),
        (["--localise", "MAP", "--map", "MAP"], "omit --map and --gt"),
        (["--hint", "1,2,3"], "only with --localise"),
        (["--map", "MAP", "--resume", "--extend"], "give only one of them"),
        (["--map", "/nowhere.dpm2map", "--extend"], "--extend: /nowhere.dpm2map: no such map file"),
        (["--localise", "NONE"], "no keyframe has descriptors"),
        (["--localise", "OTHER"], "made with weights other 0123"),
    ],
)
def test_errors_of_use(recording: Path, made: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    files = {"MAP": made, "NONE": tmp_path / "none.dpm2map", "OTHER": tmp_path / "other.dpm2map"}
    for name, weights in (("NONE", ""), ("OTHER", "other 0123")):
        with MapStore.create(files[name]) as store:
            store.begin_session("", weights)
    error = refused("run", recording, "--out", tmp_path / "o", *[files.get(a, a) for a in arguments])
    assert words in error
    assert not (tmp_path / "o").exists()
