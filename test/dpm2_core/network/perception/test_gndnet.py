# SPDX-License-Identifier: Apache-2.0
"""GndNet: its size, its grid, labels and metrics by hand, the soft threshold, and learning a slope."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dpm2_core.diffslam import SlamLoss
from dpm2_core.errors import UsageError
from dpm2_core.network.perception.gndnet import (
    GroundNet,
    GroundSettings,
    elevation_labels,
    ground_loss,
    ground_metrics,
    height_above,
    obstacle_weight,
)

SMALL = GroundSettings(cells=16, channels=8)


def scene(seed: int = 0, slope: float = 0.05) -> tuple[Tensor, Tensor]:
    """(600, 4) points and (600,) whether each is on the ground, which rises along x; a tenth is up to 2 m above it."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(600, 4, generator=generator) * torch.tensor([16.0, 16.0, 0.0, 1.0]) - torch.tensor(
        [8.0, 8, 0, 0]
    )
    points[:, 2] = -1.733 + slope * points[:, 0]
    ground = torch.arange(600) >= 60
    points[:60, 2] += 0.4 + 1.6 * torch.rand(60, generator=generator)
    return points, ground


def test_size_is_that_of_the_paper() -> None:
    """2.217 million parameters; 100 x 100 cells."""
    net = GroundNet().eval()
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(2.217e6, rel=1e-3)
    with torch.no_grad():
        assert net([scene()[0]]).shape == (1, 100, 100)


def test_points_off_the_grid_or_not_finite_change_nothing() -> None:
    """Their order does not change it, either; a scan without points gives a finite ground."""
    torch.manual_seed(0)
    net = GroundNet(SMALL).eval()
    points, _ = scene()
    nan, inf = float("nan"), float("inf")
    extra = torch.tensor([[8.1, 0, -1.7, 0], [0, -8.1, -1.7, 0], [0, 0, 9, 0], [nan, 0, 0, 0], [0, inf, 0, 0]])
    with torch.no_grad():
        plain, other = net([points, points[:0]]), net([torch.cat([points, extra]).flip(0)])
    torch.testing.assert_close(other[0], plain[0], atol=1e-5, rtol=0)
    assert bool(plain[1].isfinite().all())
    with pytest.raises(UsageError, match=r"want \(N, 4\)"):
        net([points[:, :3]])


def test_labels_are_means_of_the_ground_of_a_cell() -> None:
    """Obstacles and other cells do not count; an empty cell is unknown; the index is [x, y]."""
    points = torch.tensor([[0.2, 3.1, -1.8], [0.9, 3.9, -1.6], [0.5, 3.5, 5.0], [-7.9, -7.9, -1.0], [99, 0, 7]])
    ground = torch.tensor([True, True, False, True, True])
    labels, known = elevation_labels(points, ground, SMALL)
    assert int(known.sum()) == 2
    assert float(labels[8, 11]) == pytest.approx(-1.7)
    assert float(labels[0, 0]) == pytest.approx(-1.0)
    with pytest.raises(UsageError, match="3 for 5 points"):
        elevation_labels(points, ground[:3], SMALL)


def test_height_above_a_slope_is_exact_between_the_cells() -> None:
    """The interpolation is bilinear: a plane stays a plane, and x and y are not exchanged."""
    center = (torch.arange(16) + 0.5 - 8).double()
    elevation = 0.1 * center[:, None] - 0.2 * center[None, :]
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 14 - 7
    requested = points[:, 2] - (0.1 * points[:, 0] - 0.2 * points[:, 1])
    torch.testing.assert_close(height_above(points, elevation, SMALL), requested)


def test_loss_by_hand() -> None:
    """2 m off in known cells: smooth L1 of 1.5; unknown cells do not count; without known cells, curvature only."""
    elevation, labels = torch.full((1, 16, 16), 2.0), torch.zeros(1, 16, 16)
    known = torch.zeros(1, 16, 16, dtype=torch.bool)
    assert float(ground_loss(elevation, labels, known, SMALL)) == 0.0
    known[0, :3] = True
    labels[0, 5:] = torch.nan  # unknown cells may have any value
    assert float(ground_loss(elevation, labels, known, SMALL)) == pytest.approx(0.9 * 1.5)
    bent = elevation.clone()
    bent[0, 8, 8] += 1.0  # second differences 1, -2, 1 along each axis, of 14 * 16 of them
    assert float(ground_loss(bent, labels, known, SMALL)) == pytest.approx(0.9 * 1.5 + 0.1 * 2 * 6 / (14 * 16))


def test_metrics_by_hand() -> None:
    """A flat ground known exactly is perfect; 30 cm too low, all of it is an obstacle; points without a class do not
    count."""
    points, ground = scene(slope=0.0)
    everything = torch.ones(600, dtype=torch.bool)
    flat = torch.full((16, 16), -1.733)
    perfect = ground_metrics(points, ground, everything, flat, SMALL)
    shares = ("miou", "precision", "recall", "ground_iou", "ground_precision", "ground_recall")
    assert {name: perfect[name] for name in shares} == dict.fromkeys(shares, 1.0)
    assert perfect["mse"] == pytest.approx(0.0, abs=1e-9)
    low = ground_metrics(points, ground, everything, flat - 0.3, SMALL)
    assert low["mse"] == pytest.approx(0.09, abs=1e-5)
    assert (low["precision"], low["recall"], low["miou"]) == (0.1, 1.0, 0.05)
    counted = everything.clone()
    counted[60:330] = False  # half of the ground
    assert ground_metrics(points, ground, counted, flat - 0.3, SMALL)["precision"] == pytest.approx(60 / 330)


def test_the_authors_figures_are_of_the_ground_and_count_points_from_one() -> None:
    """Four points of ground 0.5 m above the car's level in one cell: their mean is 0.5 m, the authors' 2 / 5 m. A
    ground estimated 0.3 m too low makes all of it an obstacle: recall of the ground 0 of 4, no precision."""
    points = torch.tensor([[0.5, 0.5, 0.5 - 1.733, 0.0]] * 4 + [[0.5, 0.5, 1.0, 0.0]] * 2)
    ground = torch.tensor([True] * 4 + [False] * 2)
    everything, true = torch.ones(6, dtype=torch.bool), torch.full((16, 16), 0.5 - 1.733)
    found = ground_metrics(points, ground, everything, true, SMALL)
    assert found["mse"] == pytest.approx(0.0, abs=1e-9)
    assert found["mse_authors"] == pytest.approx((0.5 - 2.0 / 5) ** 2, rel=1e-4)
    low = ground_metrics(points, ground, everything, true - 0.3, SMALL)
    assert [low[f"ground_{name}"] for name in ("iou", "recall")] == [0, 0]
    assert math.isnan(low["ground_precision"])
    high = ground_metrics(points, ground, everything, true + 5, SMALL)  # nothing is above it
    assert [high[f"ground_{name}"] for name in ("iou", "precision", "recall")] == pytest.approx([4 / 6, 4 / 6, 1])
    none = ground_metrics(points, ~everything, everything, true, SMALL)
    assert none["mse_authors"] != none["mse_authors"]  # NaN: no ground to compare with


def test_the_authors_curvature_is_absolute_and_has_the_mixed_differences() -> None:
    """One cell 0.1 m up: 1, 2, 1 times 0.1 m along an axis, four cells in each mixed difference, divided by their
    number."""
    bump = torch.zeros(1, 16, 16)
    bump[0, 8, 8] = 0.1
    nothing = torch.zeros(1, 16, 16)
    settings = SMALL.model_copy(update={"smoothness": 1.0, "curvature": "absolute"})
    found = float(ground_loss(bump, nothing, nothing, settings))
    assert found == pytest.approx(2 * 0.4 / (14 * 16) + 2 * 0.4 / (15 * 15), rel=1e-5)
    squared = float(ground_loss(bump, nothing, nothing, settings.model_copy(update={"curvature": "squared"})))
    assert squared == pytest.approx(2 * 0.06 / (14 * 16), rel=1e-5)


def test_soft_threshold_is_the_threshold_with_a_slope() -> None:
    """Half at 0.2 m, rising, zero outside the grid; a higher ground lowers it."""
    height = torch.tensor([0.0, 0.1, 0.2, 0.3, 1.0, 1.0])
    points = torch.stack([torch.zeros(6), torch.zeros(6), height - 1.733], 1)
    points[5, 0] = 50.0
    elevation = torch.full((16, 16), -1.733, requires_grad=True)
    weight = obstacle_weight(points, elevation, SMALL)
    assert float(weight[2].detach()) == pytest.approx(0.5, abs=1e-4)
    assert bool((weight[:5].diff() > 0).all())
    assert float(weight[5].detach()) == 0.0
    assert float(torch.autograd.grad(weight.sum(), elevation)[0].sum()) < 0


def test_the_slam_loss_reaches_the_network(scans: list[Tensor]) -> None:
    """The gradient passes through weights and elevation into the pillars; the mask of the paper would have no
    gradient."""
    torch.manual_seed(0)
    settings = GroundSettings(cells=80, channels=4, sensor_height=1.7)
    net = GroundNet(settings)
    clouds = [scan.float() for scan in scans[:3]]
    elevation = net([torch.nn.functional.pad(cloud, (0, 1)) for cloud in clouds])
    weights = [obstacle_weight(cloud, ground, settings) for cloud, ground in zip(clouds, elevation, strict=True)]
    targets = [cloud[cloud[:, 2] > -1.5] for cloud in clouds]
    SlamLoss()(clouds, targets, weights).backward()
    slope = net.pillar.weight.grad
    assert slope is not None
    assert bool(slope.isfinite().all())
    assert float(slope.norm()) > 0


@pytest.mark.long
def test_it_learns_slopes() -> None:
    """Slopes up to 20 %, in 200 steps. On new ones 95 % of the variance is explained, and obstacles are found."""
    torch.manual_seed(0)
    net = GroundNet(SMALL)
    optimizer = torch.optim.Adam(net.parameters(), 1e-2)
    for step in range(200):
        scenes = [scene(8 * step + i, slope=0.4 * float(torch.rand(1) - 0.5)) for i in range(8)]
        pairs = [elevation_labels(points, ground, SMALL) for points, ground in scenes]
        labels, known = (torch.stack(parts) for parts in zip(*pairs, strict=True))
        loss = ground_loss(net([points for points, _ in scenes]), labels, known, SMALL)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    net.eval()
    for slope in (-0.15, 0.15):
        points, ground = scene(10_000, slope=slope)
        with torch.no_grad():
            found = ground_metrics(points, ground, torch.ones(600, dtype=torch.bool), net([points])[0], SMALL)
        assert found["mse"] < 0.05 * (slope**2 * 16**2 / 12)
        assert found["miou"] > 0.8
