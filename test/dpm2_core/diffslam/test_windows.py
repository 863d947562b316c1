# SPDX-License-Identifier: Apache-2.0
"""The sampler of windows and the schedule of the loss."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from dpm2_core.diffslam import ContiguousWindows, ScheduleSettings, is_due, total_loss
from dpm2_core.errors import UsageError


@given(lengths=st.lists(st.integers(0, 40), min_size=1, max_size=5), window=st.integers(2, 9), every=st.integers(1, 3))
def test_no_window_crosses_a_border(lengths: list[int], window: int, every: int) -> None:
    """Each is contiguous, in one sequence; none overlap; at an end, less than a window and its gaps is left over."""
    owner = [s for s, length in enumerate(lengths) for _ in range(length)]
    reach = (window - 1) * every + 1
    if max(lengths) < reach:
        with pytest.raises(UsageError, match="no sequence has"):
            ContiguousWindows(lengths, window, every)
        return
    windows = list(ContiguousWindows(lengths, window, every))
    for found in windows:
        assert len(found) == window
        assert all(b - a == every for a, b in pairwise(found))
        assert len({owner[i] for i in found}) == 1
    used = [i for found in windows for i in found]
    assert len(used) == len(set(used))
    for s, length in enumerate(lengths):
        assert length - sum(owner[i] == s for i in used) < window * every


def test_order_is_shuffled_anew_and_repeatable() -> None:
    """The order depends on seed and epoch; scans within a window keep their order."""
    sampler = ContiguousWindows([40, 40], 4, seed=1)
    first = list(sampler)
    sampler.set_epoch(1)
    second = list(sampler)
    sampler.set_epoch(0)
    assert first == list(sampler) != second
    assert sorted(first) == sorted(second) == sampler.windows
    assert len(sampler) == 20


def test_a_data_loader_takes_it() -> None:
    """It is a batch_sampler: a batch is a window."""
    batches = list(DataLoader(range(10), batch_sampler=ContiguousWindows([5, 5], 4)))  # type: ignore[arg-type]
    assert [batch.tolist() for batch in batches] == [[0, 1, 2, 3], [5, 6, 7, 8]]


@pytest.mark.parametrize("bad", [(1, 1), (4, 0)])
def test_windows_without_motion_are_rejected(bad: tuple[int, int]) -> None:
    """A window of one scan, or of the same scan repeated."""
    with pytest.raises(UsageError, match="want at least 2"):
        ContiguousWindows([100], *bad)


def test_every_kth_epoch_has_the_slam_loss() -> None:
    """k = 5: epochs 4, 9, ... as in the paper, 30 of 150; in other epochs it is not even computed."""
    settings = ScheduleSettings(gamma=0.5, every=5, most=None)
    assert [epoch for epoch in range(12) if is_due(epoch, settings)] == [4, 9]
    assert sum(is_due(epoch, settings) for epoch in range(150)) == 30
    assert [epoch for epoch in range(20) if is_due(epoch, ScheduleSettings(every=5, begin=7))] == [11, 16]
    calls = []

    def slam() -> torch.Tensor:
        calls.append(1)
        return torch.tensor(4.0)

    values = [float(total_loss(torch.tensor(1.0), slam, epoch, settings)) for epoch in range(5)]
    assert values == [1.0, 1.0, 1.0, 1.0, 3.0]
    assert len(calls) == 1
    assert float(total_loss(torch.tensor(1.0), slam, 4, ScheduleSettings(gamma=0.0))) == 1.0
    assert len(calls) == 1


def test_a_lost_registration_is_not_the_whole_step() -> None:
    """gamma L_slam is bounded by a fraction of L_model, and its gradient with it; below the bound it is unchanged. The
    gradient of the task is unchanged."""
    for error, ratio in ((0.05, 0.05), (0.1, 0.1), (1.0, 0.1), (100.0, 0.1), (0.0, 0.0)):
        task, slam = (torch.tensor(value, requires_grad=True) for value in (4.0, 2 * error))
        settings = ScheduleSettings(gamma=2.0, every=1, most=0.1)
        total = total_loss(task, lambda x=slam: x, 0, settings)  # gamma L_slam is `error` times L_model
        total.backward()
        assert float(total.detach()) == pytest.approx(4.0 * (1 + ratio))
        assert float(task.grad) == 1.0
        assert float(slam.grad) == pytest.approx(2.0 * (ratio / error if error else 1.0))


def test_a_task_loss_below_zero_bounds_by_its_size() -> None:
    """A likelihood may be below zero; the SLAM loss is minimized nevertheless."""
    slam = torch.tensor(9.0, requires_grad=True)
    total = total_loss(torch.tensor(-2.0), lambda: slam, 0, ScheduleSettings(gamma=1.0, every=1, most=0.5))
    total.backward()
    assert float(total.detach()) == pytest.approx(-1.0)  # gamma L_slam is half of 2
    assert float(slam.grad) == pytest.approx(1 / 9)
