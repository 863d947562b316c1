# SPDX-License-Identifier: Apache-2.0
"""The dynamic objects' task: it learns cars and walls, its figures are counts, and invalid input is rejected."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from dpm2_core.errors import UsageError
from dpm2_core.network.perception.dynamic_objects import DynamicObjectNetSettings, load
from dpm2_core.tasks.dynamic_objects_task import (
    MOVABLE,
    DynamicObjectTask,
    DynamicObjectTraining,
)
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.task import TaskOptimizer
from dpm2_core.tasks.training import new_task, save_task, train_task

SMALL = DynamicObjectTraining(
    network=DynamicObjectNetSettings(cells=32, cell=1.0, channels=8),
    epochs=24,
    every=1,
    batch=1,
    thin=0.3,
    optimiser=TaskOptimizer(rate=3e-3, ema=0.9),
)


class Drive:
    """6 scans of a plane with boxes as low as cars (10, or 252 if moving) or as high as houses (50), at random
    positions."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.scans = [self._scan(i) for i in range(6)]

    def _scan(self, number: int) -> TaskScan:
        rng = self.rng
        clouds, labels = [np.column_stack([rng.uniform(-16, 16, (4000, 2)), np.full(4000, -1.7), np.zeros(4000)])], [40]
        for k in range(10):
            label, height = ((10, 1.5), (252, 1.5), (50, 6.0))[k % 3]
            middle = rng.uniform(-13, 13, 2)
            box = np.column_stack([rng.uniform(-1, 1, (300, 2)) + middle, rng.uniform(-1.4, height - 1.7, 300)])
            clouds.append(np.column_stack([box, np.zeros(300)]))
            labels.append(label)
        each = np.concatenate([np.full(len(c), label) for c, label in zip(clouds, labels, strict=True)])
        points = torch.from_numpy(np.concatenate(clouds).astype(np.float32))
        return TaskScan(points, torch.from_numpy(each), None, "drive", number)

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> TaskScan:
        return self.scans[index]


@pytest.mark.long
def test_it_learns_what_can_move_parked_or_not(tmp_path: Path) -> None:
    """From an IoU of chance to over 0.7, on unseen scans; after saving and loading it predicts the same."""
    train, val = TaskScans([Drive(seed) for seed in range(4)]), TaskScans([Drive(99)])
    torch.manual_seed(0)  # random, but the same for any order of the tests
    untrained = DynamicObjectTask(SMALL).eval()
    with torch.no_grad():
        before = untrained.evaluate(val)
    task = train_task(new_task("movers", SMALL), train, tmp_path / "run")
    with torch.no_grad():
        after = task.evaluate(val)
    assert before["iou"] < 0.4
    assert after["iou"] > 0.7
    assert after["recall_moving"] > 0.7
    save_task(task, tmp_path / "w.safetensors", {}, half=False)
    points = val[0].points.numpy()
    assert isinstance(task, DynamicObjectTask)
    np.testing.assert_array_equal(load(tmp_path / "w.safetensors").probability(points), task.net.probability(points))


def test_figures_are_counts_of_points() -> None:
    """If all is found, precision is the fraction of movable points among labelled ones; with none movable, NaN."""
    task, scan = DynamicObjectTask(SMALL).eval(), Drive(1)[0]
    assert scan.labels is not None
    with torch.no_grad():
        task.net.head.weight.zero_()
        task.net.head.bias.fill_(9.0)
        found = task.evaluate(TaskScans([_One(scan)]))
        inside = (scan.points[:, :2].abs() < 16).all(1)
        movable = torch.isin(scan.labels, torch.tensor([*MOVABLE, 252]))
        assert found["precision"] == pytest.approx(float(movable.double().mean() / inside.double().mean()), rel=1e-3)
        assert found["recall"] == found["recall_moving"] == 1.0
        task.net.head.bias.fill_(-9.0)
        still = TaskScan(scan.points, torch.full_like(scan.labels, 50), None, "drive", 0)
        assert all(np.isnan(value) for value in task.evaluate(TaskScans([_One(still)])).values())


def test_scans_without_classes_are_an_error_of_use() -> None:
    scan = TaskScan(torch.zeros(10, 4), None, None, "drive", 3)
    with pytest.raises(UsageError, match="drive, scan 3: no labels"):
        DynamicObjectTask(SMALL).losses([scan])


def test_dynamic_objects_of_one_scan_are_put_into_another() -> None:
    """With a network that predicts everything as dynamic, the loss falls with the number of dynamic objects."""
    cars = Drive(3)[0]
    assert cars.labels is not None
    empty = TaskScan(cars.points, torch.full_like(cars.labels, 50), None, "drive", 1)
    loss = []
    for paste in (0.0, 1.0):
        torch.manual_seed(0)
        task = DynamicObjectTask(SMALL.model_copy(update={"paste": paste, "thin": 0.0}))
        with torch.no_grad():
            task.net.head.weight.zero_()
            task.net.head.bias.fill_(9.0)
            loss.append(float(task.losses([empty, cars])[0]))
    assert loss[1] < 0.98 * loss[0]


def test_a_training_ends_with_the_statistics_of_whole_scans() -> None:
    """Earlier statistics do not matter; what was learned is kept, and the same scans give the same result."""
    scans = TaskScans([Drive(5)])
    torch.manual_seed(0)
    task = DynamicObjectTask(SMALL).eval()
    learned = {name: value.clone() for name, value in task.named_parameters()}
    answers = []
    for factor in (1.0, 30.0):
        for name, value in task.named_buffers():
            if name.endswith("running_mean"):
                value.add_(factor)
        unsettled = task.net.probability(scans[0].points.numpy())
        task.settle(scans)
        answers.append(task.net.probability(scans[0].points.numpy()))
        assert not np.array_equal(unsettled, answers[-1])
    np.testing.assert_array_equal(*answers)
    assert not any(layer.training for layer in task.modules())
    for name, value in task.named_parameters():
        torch.testing.assert_close(value, learned[name], rtol=0, atol=0)


def test_the_average_of_the_weights_is_kept_where_one_is_asked_for(tmp_path: Path) -> None:
    """The same training ends with other weights, but closer to its last weights than to its first."""
    scans = TaskScans([Drive(5)])

    def settings(average: float) -> DynamicObjectTraining:
        optimiser = TaskOptimizer(rate=3e-3, warmup=1, ema=average)
        return SMALL.model_copy(update={"epochs": 4, "optimiser": optimiser})

    first = list(new_task("movers", settings(0)).parameters())
    last = list(train_task(new_task("movers", settings(0)), scans, tmp_path / "last").parameters())
    average = list(train_task(new_task("movers", settings(0.9)), scans, tmp_path / "average").parameters())
    assert 0 < _distance(average, last) < 0.5 * _distance(first, last)


def test_points_that_are_not_finite_teach_nothing() -> None:
    torch.manual_seed(0)
    scan = Drive(2)[0]
    assert scan.labels is not None
    points = torch.cat([scan.points, torch.full((5, 4), torch.nan)])
    broken = TaskScan(points, torch.cat([scan.labels, torch.full((5,), 252)]), None, "drive", 0)
    loss, slam = DynamicObjectTask(SMALL).losses([broken, broken])
    assert slam is None
    assert bool(loss.isfinite())


class _One(Drive):
    """A sequence of one scan."""

    def __init__(self, scan: TaskScan) -> None:
        self.scans = [scan]


def _distance(a: Sequence[torch.Tensor], b: Sequence[torch.Tensor]) -> float:
    return float(torch.stack([(x - y).detach().norm() for x, y in zip(a, b, strict=True)]).norm())
