# SPDX-License-Identifier: Apache-2.0
"""Odometry on the clouds that a task makes, evaluated with the ground truth of a small synthetic drive."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from dpm2_core.errors import UsageError
from dpm2_core.network.perception.range_image import RangeImageSettings
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, LidarConfig
from dpm2_core.tasks.ae_lidar import AeLidarSettings
from dpm2_core.tasks.ae_lidar_task import AeLidarTask, AeLidarTraining
from dpm2_core.tasks.ground_task import GroundTask, GroundTraining
from dpm2_core.tasks.open import folders_of, names_of, open_scans
from dpm2_core.tasks.slam_figures import figures_of, slam_figures, slam_runs


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives of 4 scans; both sequences are called 00."""
    root = tmp_path_factory.mktemp("drives")
    for seed in range(2):
        simulate(
            root / f"{seed}",
            DriveConfig(frames=4, seed=seed, road="straight", images=False, lidar=LidarConfig(columns=128)),
        )
    return root


@pytest.fixture
def task() -> AeLidarTask:
    """An untrained task."""
    torch.manual_seed(0)
    image = RangeImageSettings(scale=50, columns=128)
    return AeLidarTask(AeLidarTraining(network=AeLidarSettings(image=image, channels=4, latent=8))).eval()


def test_a_folder_above_sequences_chooses_them(drives: Path) -> None:
    """Training and test data may be two folders of drives whose sequences are all called 00."""
    assert len(open_scans(drives)) == 2 * len(open_scans(drives, sequences=["1"])) == 8
    assert [names_of(folder, drives) for folder in folders_of(drives, ["00"])] == [["0", "00"], ["1", "00"]]
    with pytest.raises(UsageError, match="no sequence 2; there are 0, 00, 1"):
        open_scans(drives, sequences=["2"])


@pytest.mark.slow
def test_a_perfect_network_is_as_good_as_its_input(
    drives: Path, task: AeLidarTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Identity replaces the network: equal figures, under 0.1 m as for a drive of 3 m; untrained, they are worse.

    128 columns move a point of a wall 20 m away by up to 0.5 m, so the accuracy is in centimeters.
    """
    untrained = slam_figures(task, drives / "0")
    monkeypatch.setattr(task.network, "forward", lambda images: (images, images.new_zeros(len(images))))
    found = slam_figures(task, drives)
    for figure in ("ate_m", "rpe_m", "rpe_deg"):
        assert found[f"output_{figure}"] == found[f"input_{figure}"]
    assert found["input_ate_m"] < 0.1
    assert found["input_rpe_m"] < 0.1
    assert untrained["output_ate_m"] > 10 * found["output_ate_m"]
    alone = [untrained["input_ate_m"], slam_figures(task, drives, ["1"])["input_ate_m"]]
    assert found["input_ate_m"] == pytest.approx(sum(alone) / 2)  # each drive is evaluated by its own scans


@pytest.mark.slow
def test_missing_scans_are_a_pause_and_no_step(drives: Path, task: AeLidarTask, tmp_path: Path) -> None:
    """Numbers 0 to 3 and 20 to 23: the clouds have their stamps, and the step across the gap does not count for the
    RPE.

    Both parts are the same scans at the same poses: an odometry that stands still has the same error in each step.
    """
    copied = tmp_path / "00"
    shutil.copytree(drives / "0" / "sequences" / "00", copied)
    whole = slam_figures(task, copied)
    for kind in ("velodyne", "labels", "static"):
        for path in sorted((copied / kind).iterdir()):
            shutil.copy(path, path.with_stem(f"{int(path.stem) + 20:06d}"))
    lines = (copied / "poses.txt").read_text().splitlines()
    (copied / "poses.txt").write_text("\n".join([*lines, *lines[-1:] * 16, *lines]) + "\n")
    times = (copied / "times.txt").read_text().splitlines()
    (copied / "times.txt").write_text("\n".join([*times, *(f"{i / 10}" for i in range(4, 24))]) + "\n")
    [run] = slam_runs(task, copied, [])
    assert np.diff(run.stamps).tolist() == [100_000_000] * 3 + [1_700_000_000] + [100_000_000] * 3
    assert figures_of(run)["still_rpe_m"] == pytest.approx(whole["still_rpe_m"])


@pytest.mark.slow
def test_what_cannot_be_checked_is_rejected(drives: Path, task: AeLidarTask, tmp_path: Path) -> None:
    """Without poses, or with a task that makes no clouds."""
    copied = tmp_path / "00"
    shutil.copytree(drives / "0" / "sequences" / "00", copied)
    (copied / "poses.txt").unlink()
    with pytest.raises(UsageError, match="no true poses of its 4 scans"):
        slam_figures(task, copied)
    with pytest.raises(UsageError, match="gndnet: this task outputs no clouds"):
        slam_figures(GroundTask(GroundTraining()).eval(), drives)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no sequences with poses"):
        slam_figures(task, tmp_path / "empty")
