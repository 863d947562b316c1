# SPDX-License-Identifier: Apache-2.0
"""The examples with a reader's arguments, on a small simulated drive: their output is correct."""

from __future__ import annotations

import json
import os
import runpy
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from traceback import print_exc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpm2_core import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.geometry import se3

from ..helpers.command import Done
from ..helpers.drives import first_scans

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
FRAMES = 14


@pytest.fixture(scope="module")
def recording(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 13 m of the recording."""
    return first_scans(recording, FRAMES, tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def truth(recording: Path) -> np.ndarray:
    """(N, 4, 4) T_first_lidar."""
    poses = open_source(recording).poses
    assert poses is not None
    return np.asarray(se3.inverse(poses[0]) @ poses)


def example(name: str, *arguments: object) -> Done:
    """Run an example in this process, so that imports take time only once."""
    path, out, err, code = EXAMPLES / f"{name}.py", StringIO(), StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", [str(path), *map(str, arguments)])
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            code = 1 if isinstance(end.code, str) else int(end.code or 0)
        except Exception:
            print_exc()
            code = 1
    return Done(code, out.getvalue(), err.getvalue())


@pytest.mark.slow
def test_odometry_of_a_folder_in_ten_lines(recording: Path, truth: np.ndarray, tmp_path: Path) -> None:
    done = example("odometry_of_a_folder", recording, tmp_path / "poses.txt")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{FRAMES} frames, 0 of them not registered\n"
    estimate = np.loadtxt(tmp_path / "poses.txt").reshape(-1, 3, 4)
    assert np.linalg.norm(estimate[:, :, 3] - truth[:, :3, 3], axis=1).max() < 0.1  # as in test_run.py
    lines = (EXAMPLES / "odometry_of_a_folder.py").read_text().splitlines()
    assert len([line for line in lines if line and not line.startswith(("#", '"""'))]) <= 10


@pytest.mark.slow
def test_register_two_scans_and_draw_them(recording: Path, truth: np.ndarray, tmp_path: Path) -> None:
    """They are about 5 m apart; the network alone is accurate to a few decimeters."""
    done = example("register_two_scans", recording, 0, 5, tmp_path / "matches.png")
    assert done.returncode == 0, done.stderr
    found = [float(word) for word in done.stdout.split(" m in ")[0].split()[-3:]]
    assert np.linalg.norm(found - truth[5, :3, 3]) < 0.5
    assert (tmp_path / "matches.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_map_then_localize(recording: Path, truth: np.ndarray, tmp_path: Path) -> None:
    done = example("map_then_localize", recording, recording, tmp_path / "street.dpm2map")
    assert done.returncode == 0, done.stderr
    rows = np.array([line.split() for line in done.stdout.splitlines()], float)
    assert len(rows) == FRAMES  # localized at once
    assert np.linalg.norm(rows[:, 1:] - truth[:, :3, 3], axis=1).max() < 0.1  # as in test_localise.py


@pytest.mark.slow
def test_a_recording_that_is_not_there_is_one_clear_error(tmp_path: Path) -> None:
    done = example("odometry_of_a_folder", tmp_path / "nowhere", tmp_path / "poses.txt")
    assert done.returncode != 0
    assert (
        done.stderr.splitlines()[-1] == f"dpm2_core.errors.UsageError: {tmp_path / 'nowhere'}: no such file or folder"
    )


@pytest.mark.slow
def test_a_loader_of_ones_own(recording: Path, tmp_path: Path) -> None:
    """With ground truth for all scans but one, a scan that is not an array, and one of another shape."""
    folder = tmp_path / "clouds"
    folder.mkdir()
    source = open_source(recording, InputSettings(images=False))
    assert source.poses is not None
    rows = []
    for frame, T in zip(source.frames(0, 8), source.poses, strict=False):
        np.save(folder / f"{frame.stamp}.npy", frame.points)
        rows.append([frame.stamp, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])
    np.savetxt(folder / "poses.csv", rows[:-1], delimiter=",", fmt=["%d"] + ["%.9f"] * 7)
    (folder / "9000000000000000000.npy").write_bytes(b"nothing")
    np.save(folder / "9000000000100000000.npy", np.zeros((5, 3)))
    done = example("custom_loader", folder, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    frames, failed, error = (part.split()[0] for part in done.stdout.split(","))
    assert (frames, failed) == ("10", "2")
    assert error == "APE"
    assert float(done.stdout.split()[-2]) < 0.1
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["failed_frames"] == 2
    empty = example("custom_loader", tmp_path, tmp_path / "out")
    assert "no STAMP.npy" in empty.stderr.splitlines()[-1]


@pytest.mark.slow
def test_wheel_odometry_carries_over_what_the_points_cannot(recording: Path) -> None:
    """With every eighth scan, 8 m apart, wheel odometry reduces the error."""
    done = example("wheel_odometry", recording, 8)
    assert done.returncode == 0, done.stderr
    alone, fused = (float(line.split(": ")[1].split(" m")[0]) for line in done.stdout.splitlines())
    assert fused < 0.3
    assert fused < alone


@pytest.mark.slow
def test_the_slam_loss_on_a_model_of_ones_own(recording: Path) -> None:
    """Both losses decrease."""
    done = example("slam_loss", recording, 8)
    assert done.returncode == 0, done.stderr
    before, after = ([float(line.split()[3]), float(line.split()[5])] for line in done.stdout.splitlines())
    assert after[0] < before[0] / 2
    assert after[1] < before[1]


@pytest.mark.slow
def test_the_slam_loss_falls_on_real_scans_too(kitti_root: Path) -> None:
    """They decrease as far as the example states."""
    done = example("slam_loss", kitti_root / "sequences" / "04", 20)
    assert done.returncode == 0, done.stderr
    before, after = ([float(line.split()[3]), float(line.split()[5])] for line in done.stdout.splitlines())
    assert after[0] < before[0] / 50
    assert after[1] < before[1] / 20


@pytest.mark.long
@pytest.mark.weights
def test_the_notebook(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of its cells run, and it is stored without their output."""
    nbclient = pytest.importorskip("nbclient", reason="no nbclient: pip install '.[test]'")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(EXAMPLES / "tour.ipynb", as_version=4)
    assert not [cell for cell in notebook.cells if cell.get("outputs")]
    monkeypatch.setenv("DPM2_RECORDING", str(recording))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    nbclient.NotebookClient(notebook, timeout=200, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ()))
    assert "tracking confidence" in printed
    assert "(320, 3) (320, 128)" in printed
    assert (tmp_path / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    assert any("image/png" in output.get("data", {}) for output in notebook.cells[-1].outputs)
