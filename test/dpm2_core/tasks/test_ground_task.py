# SPDX-License-Identifier: Apache-2.0
"""GndNet as a task: its SLAM loss behaves as the paper intends, and its figures are those of the labels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from dpm2_core.diffslam.schedule import ScheduleSettings
from dpm2_core.errors import UsageError
from dpm2_core.network.perception.gndnet import elevation_labels, load
from dpm2_core.tasks.drives import TaskDriveSettings, make_task_drives
from dpm2_core.tasks.ground_task import GroundTask, GroundTraining, filled, ground_of, random_tilt
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.training import load_task, measure

SETTINGS = GroundTraining.model_validate(
    {"network": {"cells": 48, "cell": 2.0, "channels": 4}, "tilt": 0.0, "slam_loss": {"points": 500}}
)


SHIPPED = Path(__file__).resolve().parents[3] / "dpm2_core" / "weights" / "gndnet.safetensors"


class Known(nn.Module):
    """Replaces the network: the true elevation, raised by `offset`, m."""

    def __init__(self, scans: list[TaskScan], offset: Tensor) -> None:
        super().__init__()
        network = SETTINGS.network
        truth = [filled(*elevation_labels(s.points, ground_of(s)[0], network)) for s in scans]
        self.truth, self.offset = torch.stack(truth), nn.Parameter(offset)

    def forward(self, clouds: list[Tensor]) -> Tensor:
        return self.truth[: len(clouds)] + self.offset


@pytest.fixture
def scans(write_drive: Callable[..., Path], tmp_path: Path) -> TaskScans:
    """Three labelled scans of one street."""
    return open_scans(write_drive(tmp_path / "drive", range(3), points=3000))


def with_elevation(scans: TaskScans, offset: float) -> tuple[GroundTask, list[TaskScan], Any]:
    """A task that finds the true elevation plus an offset; the window; its parameter."""
    window = [scans[i] for i in range(3)]
    task = GroundTask(SETTINGS)
    known = Known(window, torch.tensor(offset))
    task.net = known  # type: ignore[assignment]
    return task, window, known.offset


def test_the_true_elevation_costs_nothing(scans: TaskScans) -> None:
    """Neither the task, except for its curvature, nor the SLAM has a loss; and there is no gradient."""
    task, window, offset = with_elevation(scans, 0.0)
    loss, slam = task.losses(window)
    assert float(loss.detach()) < 0.01
    value = slam()
    value.backward()
    assert float(value.detach()) == pytest.approx(0.0, abs=1e-18)
    assert float(offset.grad) == pytest.approx(0.0, abs=1e-9)


def test_the_slam_loss_sees_a_wrong_elevation(scans: TaskScans) -> None:
    """A ground 0.3 m too low turns the road into obstacles, which changes the trajectory; the gradient is finite."""
    task, window, offset = with_elevation(scans, -0.3)
    value = task.losses(window)[1]()
    value.backward()
    assert float(value.detach()) > 1e-6
    assert math.isfinite(float(offset.grad))
    assert float(offset.grad) != 0


def test_figures_of_the_true_elevation(scans: TaskScans) -> None:
    """The height has no error; points that are not labelled as ground are found, points labelled as ground are not."""
    task, _, _ = with_elevation(scans, 0.0)

    def of_its_own(clouds: list[Tensor]) -> Tensor:
        return torch.full((1, 48, 48), -1.7)

    task.net.forward = of_its_own  # type: ignore[method-assign]
    found = measure(task, scans)
    assert found["mse"] < 1e-4 + 2e-4  # the noise of 1 cm, of cells with few points
    assert found["precision"] > 0.99
    high = []  # half of the boxes is below the road and cannot be found
    for scan in (scans[i] for i in range(3)):
        ground, counted = ground_of(scan)
        inside = scan.points[:, :2].abs().amax(1) < 48
        high.append(float((scan.points[~ground & counted & inside, 2] > -1.5).float().mean()))
    assert found["recall"] == pytest.approx(sum(high) / 3, abs=1e-3)


def test_gaps_count_as_much_as_they_are_told_to(scans: TaskScans) -> None:
    """An elevation that is wrong where no ground was seen costs nothing, unless the gaps have a weight."""
    task, window, _ = with_elevation(scans, 0.0)
    plain = float(task.losses(window)[0].detach())
    known = torch.stack([elevation_labels(s.points, ground_of(s)[0], SETTINGS.network)[1] for s in window])
    assert 0.05 < float(known.float().mean()) < 0.95
    task.net.truth = task.net.truth + 2.0 * ~known  # type: ignore[operator]
    costs = []
    for gaps in (0.0, 0.1, 1.0):
        # Without the curvature, which responds to the steps at the borders of the gaps.
        network = SETTINGS.network.model_copy(update={"smoothness": 0.0})
        task.settings = SETTINGS.model_copy(update={"gaps": gaps, "network": network})
        costs.append(float(task.losses(window)[0].detach()))
    assert costs[0] <= plain
    ratio = float((~known).sum() / known.sum())
    assert costs[1] == pytest.approx(1.5 * 0.1 * ratio / (1 + 0.1 * ratio), rel=0.01)  # smooth L1 of 2 m is 1.5
    assert costs[2] == pytest.approx(1.5 * ratio / (1 + ratio), rel=0.01)


def test_tilt_is_a_rotation_of_the_whole_window(scans: TaskScans) -> None:
    """It has roll and pitch within the bound; the labels are rotated as well, and it differs each time."""
    torch.manual_seed(0)
    turns = [random_tilt(0.1) for _ in range(20)]
    for turn in turns:
        torch.testing.assert_close(turn @ turn.T, torch.eye(3))
        assert float(turn.det()) == pytest.approx(1.0, abs=1e-5)
        assert abs(float(torch.atan2(turn[2, 1], turn[2, 2]))) <= 0.1
        assert abs(float(torch.asin(turn[2, 0]))) <= 0.1
    assert not torch.equal(turns[0], turns[1])
    tilted = GroundTask(SETTINGS.model_copy(update={"tilt": 8.0}))
    window = [scans[i] for i in range(3)]
    torch.manual_seed(1)
    a = float(tilted.losses(window)[0].detach())
    torch.manual_seed(1)
    assert float(tilted.losses(window)[0].detach()) == a
    assert float(tilted.losses(window)[0].detach()) != a


def test_gaps_take_the_nearest_cell_that_is_known() -> None:
    """They stay zero if no cell is known."""
    elevation, known = torch.zeros(6, 6), torch.zeros(6, 6, dtype=torch.bool)
    assert torch.equal(filled(elevation, known), elevation)
    known[0, 0] = known[5, 5] = True
    elevation[0, 0], elevation[5, 5], elevation[3, 3] = -1.7, -1.2, 99.0
    found = filled(elevation, known)
    assert float(found[1, 2]) == pytest.approx(-1.7)
    assert float(found[3, 3]) == pytest.approx(-1.2)


def test_a_scan_without_obstacles_or_without_classes_counts_in_no_figure_of_them(scans: TaskScans) -> None:
    """The ground is known exactly: each figure is over the scans that have it, and is not lower for an empty road."""
    task, window, _ = with_elevation(scans, 0.0)
    usual = measure(task, TaskScans([window[:1]]))
    assert usual["recall"] > 0
    assert window[0].labels is not None
    ground = ground_of(window[0])[0]
    road = replace(window[0], points=window[0].points[ground], labels=window[0].labels[ground])
    nothing = replace(window[0], labels=torch.zeros_like(window[0].labels))
    found = measure(task, TaskScans([[window[0], road, nothing]]))
    assert found["recall"] == pytest.approx(usual["recall"])
    empty = measure(task, TaskScans([[road]]))
    assert math.isnan(empty["recall"])
    assert empty["miou"] == empty["ground_iou"] > 0.9


@pytest.mark.slow
@pytest.mark.weights
def test_the_shipped_weights_know_an_unseen_suburb(tmp_path: Path) -> None:
    """The file is small, loads strictly, finds the ground of another world to 30 cm (RMS, out to 50 m), and most of the
    obstacles on it."""
    assert SHIPPED.stat().st_size < 5e6
    assert load(SHIPPED).settings.cells == 100
    drives = {"train": 1, "train_frames": 2, "val": 1, "val_frames": 2, "first_seed": 31_000, "presets": ["suburb"]}
    make_task_drives(tmp_path, TaskDriveSettings.model_validate(drives), 1)
    found = measure(load_task("gndnet", SHIPPED), open_scans(tmp_path))
    assert found["mse"] < 0.3**2
    assert found["miou"] > 0.8


def test_a_scan_without_labels_teaches_by_its_slam_alone(scans: TaskScans, tmp_path: Path) -> None:
    """Its own loss is the curvature; the reference uses all its points, so that a ground that hides them is penalized.
    Without a SLAM loss it gives nothing to learn; the loss of a labelled scan is unchanged."""
    task, window, offset = with_elevation(scans, 0.0)
    labelled, _ = task.losses(window)
    bare = [replace(scan, labels=None) for scan in window]
    with pytest.raises(UsageError, match="scan 0: no labels"):
        task.losses(bare)
    task.settings = SETTINGS.model_copy(update={"slam": ScheduleSettings(gamma=1.0)})
    loss, slam = task.losses(bare)
    assert slam is not None
    bend = SETTINGS.network.smoothness * sum(task.net.truth.diff(n=2, dim=a).square().mean() for a in (1, 2))
    assert float(loss.detach()) == pytest.approx(float(bend))
    assert float(torch.autograd.grad(slam(), offset)[0].abs()) > 0
    assert float(task.losses(window)[0].detach()) == pytest.approx(float(labelled.detach()))
    assert GroundTask.learns_from(task.settings) == ()
    assert GroundTask.learns_from(SETTINGS) == ("labels",)
