# SPDX-License-Identifier: Apache-2.0
"""The trainer of the tasks: it learns, resumes to the same curve, keeps the schedule, and never stores a NaN."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from dpm2_core.diffslam import SlamLoss
from dpm2_core.errors import UsageError
from dpm2_core.learning.checkpoint import WEIGHTS, read_log
from dpm2_core.network.perception import dslr, dynamic_objects, gndnet
from dpm2_core.tasks.ground_task import GroundTask, GroundTraining
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.task import task_type
from dpm2_core.tasks.training import (
    draw,
    load_task,
    mean_figures,
    measure,
    new_task,
    save_task,
    train_task,
)

TINY = {"cells": 32, "cell": 2.0, "channels": 4}


def settings(**changes: Any) -> GroundTraining:
    """Two windows of three scans per epoch, a small network, the SLAM loss in every second epoch."""
    tree = {
        "network": TINY, "epochs": 4, "window": 3, "every": 1, "optimiser": {"warmup": 2, "rate": 3e-3}, "tilt": 2.0,
        "slam": {"gamma": 0.5, "every": 2, "most": None}, "slam_loss": {"points": 300},
    }  # fmt: skip
    return GroundTraining.model_validate({**tree, **changes})


@pytest.fixture
def scans(write_drive: Callable[..., Path], tmp_path: Path) -> TaskScans:
    """Six labelled scans of one street."""
    return open_scans(write_drive(tmp_path / "drive"))


@pytest.mark.slow
def test_it_learns_and_logs(scans: TaskScans, tmp_path: Path) -> None:
    """The task loss falls by half in 40 steps; both losses are logged, the SLAM loss in the epochs that use it."""
    out = tmp_path / "out"
    train_task(new_task("gndnet", settings(epochs=20)), scans, out, val=scans)
    log = read_log(out)
    steps = [row for row in log if "norm" in row]
    assert [row["step"] for row in steps] == list(range(40))
    losses = [row["task_loss"] for row in steps]
    assert sum(losses[-4:]) < 0.5 * sum(losses[:4])
    with_slam = [row["step"] for row in steps if "slam_loss" in row]
    assert with_slam == [step for step in range(40) if step // 2 % 2 == 1]
    for row in steps:
        assert row["loss"] == pytest.approx(row["task_loss"] + 0.5 * row.get("slam_loss", 0), abs=2e-6)  # 6 decimals
    assert [row["step"] for row in log if "miou" in row] == [9, 19, 29, 39]  # every fifth epoch


@pytest.mark.slow
def test_scans_are_contiguous_only_where_the_slam_loss_counts(
    scans: TaskScans, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In other epochs, a step has scans of all places. Within an epoch each scan occurs once, in an order that differs
    between epochs. The weight of the SLAM loss, even zero, does not change which scans a training uses."""
    original = GroundTask.losses
    seen: list[list[int]] = []

    def losses(self: GroundTask, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor]]:
        seen.append([scan.number for scan in window])
        return original(self, window)

    monkeypatch.setattr(GroundTask, "losses", losses)
    orders = []
    for gamma in (0.5, 0.0):
        seen.clear()
        task = new_task("gndnet", settings(epochs=8, slam={"gamma": gamma, "every": 2}))
        train_task(task, scans, tmp_path / f"{gamma}")
        orders.append([*seen])
    assert orders[0] == orders[1]
    epochs = [orders[0][i : i + 2] for i in range(0, 16, 2)]
    assert all(sorted(epoch) == [[0, 1, 2], [3, 4, 5]] for epoch in epochs[1::2])
    shuffled = [(*one, *other) for one, other in epochs[::2]]
    assert all(sorted(order) == [0, 1, 2, 3, 4, 5] for order in shuffled)
    assert len(set(shuffled)) == 4  # of 720 orders; the seed is fixed
    assert (0, 1, 2, 3, 4, 5) not in shuffled


@pytest.mark.slow
@pytest.mark.parametrize("placebo", [False, True])
def test_resumed_equals_uninterrupted(scans: TaskScans, tmp_path: Path, placebo: bool) -> None:
    """Stopped after 2 of 4 epochs and resumed: the same losses in the log and the same weights, bit for bit."""
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    chosen = settings(slam_loss={"points": 300, "placebo": placebo})
    train_task(new_task("gndnet", chosen), scans, whole)
    train_task(new_task("gndnet", chosen), scans, halves, until=2)
    assert len(read_log(halves)) == 4
    train_task(new_task("gndnet", chosen), scans, halves)
    curve = [[(row["step"], row["loss"], row["norm"]) for row in read_log(out)] for out in (whole, halves)]
    assert curve[0] == curve[1]
    one, other = (load_file(out / WEIGHTS) for out in (whole, halves))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_gamma_zero_is_the_task_alone(scans: TaskScans, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The SLAM is not even run."""
    monkeypatch.setattr(SlamLoss, "forward", None)
    train_task(new_task("gndnet", settings(slam={"gamma": 0.0, "every": 1})), scans, tmp_path / "out")
    assert not any("slam_loss" in row for row in read_log(tmp_path / "out"))


@pytest.mark.slow
@pytest.mark.parametrize("where", ["task", "slam", "gradient"])
def test_what_is_not_finite_never_reaches_a_checkpoint(
    scans: TaskScans, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """A step whose loss or gradient is NaN is skipped, including its running means; the other steps still learn."""
    original = GroundTask.losses
    calls = []

    def losses(self: GroundTask, window: list[TaskScan]) -> tuple[Tensor, Callable[[], Tensor]]:
        calls.append(len(window))
        if len(calls) != 4:  # the second step of an epoch with the SLAM loss
            return original(self, window)
        if where == "task":
            with torch.no_grad():  # as a damaged scan would do to the running means
                next(b for b in self.buffers() if b.is_floating_point()).fill_(math.nan)
        loss, slam = original(self, window)
        if where == "slam":
            return loss, lambda: slam() * math.nan
        if where == "gradient":  # finite itself, but the gradient of a root at zero is not
            return loss + (loss - loss.detach()).abs().sqrt(), slam
        return loss * math.nan, slam

    monkeypatch.setattr(GroundTask, "losses", losses)
    out = tmp_path / "out"
    train_task(new_task("gndnet", settings()), scans, out)
    assert [row["step"] for row in read_log(out) if row["norm"] is None] == [3]
    assert all(row["loss"] is not None for row in read_log(out) if row["step"] > 3)
    state = torch.load(out / "checkpoint.pt", weights_only=True)
    stored = [*state["module"].values(), *state["ema"].values(), *load_file(out / WEIGHTS).values()]
    moments = [v for values in state["optimiser"]["state"].values() for v in values.values()]
    assert all(bool(torch.as_tensor(value).isfinite().all()) for value in [*stored, *moments])


def test_measuring_changes_nothing(scans: TaskScans) -> None:
    """Running means and mode do not change; figures are those of the scans."""
    torch.manual_seed(0)
    task = GroundTask(settings()).train()
    before = {name: value.clone() for name, value in task.state_dict().items()}
    figures = measure(task, scans)
    assert task.training
    assert all(torch.equal(value, before[name]) for name, value in task.state_dict().items())
    assert figures.keys() >= {"mse", "miou", "precision", "recall", "mse_authors", "ground_iou"}
    assert mean_figures([{"a": 1.0, "b": math.nan}, {"a": 2.0, "b": 3.0}]) == {"a": 1.5, "b": 3.0}


@pytest.mark.slow
def test_weights_come_back(scans: TaskScans, tmp_path: Path) -> None:
    """They include the settings of the network, for the task and for the SLAM; in fp16 to its precision."""
    task = train_task(new_task("gndnet", settings()), scans, tmp_path / "out")
    requested = measure(task, scans)
    assert measure(load_task("gndnet", tmp_path / "out" / WEIGHTS), scans) == requested
    save_task(task, tmp_path / "half.safetensors", {}, half=True)
    assert measure(load_task("gndnet", tmp_path / "half.safetensors"), scans)["mse"] == pytest.approx(
        requested["mse"], rel=0.05
    )
    net = gndnet.load(tmp_path / "out" / WEIGHTS)
    assert net.settings == task.settings.network
    with torch.no_grad():
        found = net([scans[0].points])
        torch.testing.assert_close(found, task.net([scans[0].points]))
    draw(task, scans, 1, tmp_path / "ground.png")
    assert (tmp_path / "ground.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UsageError, match="scan 6: there are only 6 scans"):
        draw(task, scans, 6, tmp_path / "none.png")


@pytest.mark.parametrize(
    ("name", "load", "tensor"),
    [
        ("gndnet", gndnet.load, "net.head.bias"),
        ("movers", dynamic_objects.load, "net.head.bias"),
        ("dslr", dslr.load, "network.decoder.layers.0.weight"),
        ("ae_lidar", partial(load_task, "ae_lidar"), "network.decoder.0.weight"),
    ],
)
def test_wrong_weights_are_rejected(tmp_path: Path, name: str, load: Callable[[Path], nn.Module], tensor: str) -> None:
    """No file, a pickle, another task's, no settings, wrong ones, other shapes, NaN: each error names its cause."""
    path = tmp_path / "w.safetensors"
    kind = task_type(name)
    task = kind(kind.training_type(network={"channels": 8}))  # type: ignore[arg-type]
    state = {key: value.contiguous() for key, value in task.state_dict().items()}
    about = {"task": name, "network": task.settings.network.model_dump_json()}

    def rejected(message: str) -> None:
        for either in (partial(load_task, name), load):
            with pytest.raises(UsageError, match=message):
                either(path)

    rejected("no such weights")
    torch.save(state, path)
    rejected("pickled weights are never loaded")
    for tensors, metadata, message in (
        (state, {**about, "task": "others"}, f"weights of others, not of {name}"),
        (state, {"preset": "small"}, f"weights of no task, not of {name}"),
        (state, {"task": name}, "without a network description"),
        (state, {**about, "network": '{"channels": 0}'}, "channels: input should be greater than"),
        (state, {**about, "network": '{"channels": 16}'}, "tensors differ, such as net"),
        ({key: v for key, v in state.items() if key != tensor}, about, f"such as {tensor}"),
        ({**state, tensor: torch.full_like(state[tensor], math.nan)}, about, "holds values that are not finite"),
    ):
        save_file(tensors, path, metadata)
        rejected(message)


def test_windows_that_do_not_fit(scans: TaskScans, tmp_path: Path) -> None:
    """A window longer than any sequence; a checkpoint of another network."""
    with pytest.raises(UsageError, match="no sequence has the 13 scans"):
        train_task(new_task("gndnet", settings(window=7, every=2)), scans, tmp_path / "out")
    train_task(new_task("gndnet", settings()), scans, tmp_path / "out", until=1)
    with pytest.raises(UsageError, match="checkpoint of another network"):
        train_task(new_task("gndnet", settings(network={**TINY, "channels": 8})), scans, tmp_path / "out")
