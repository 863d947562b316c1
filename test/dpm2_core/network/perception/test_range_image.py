# SPDX-License-Identifier: Apache-2.0
"""Range images: the slots of points, the filling of gaps, and the conversion back to points, with its gradient."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from dpm2_core.errors import UsageError
from dpm2_core.network.perception.range_image import RangeImageSettings, azimuths, elevations, fill, project, to_points
from dpm2_core.sim.beams import elevations as sensor_elevations

SETTINGS = RangeImageSettings()
VLP16 = RangeImageSettings(beams=((15.0, -15.0, 16),), first=0, rows=16, columns=128)


def points_of_beams(settings: RangeImageSettings, distance: float = 20.0) -> Tensor:
    """(rows * columns, 3): one point in the middle of each slot, each with a different horizontal distance."""
    elevation, azimuth = elevations(settings)[:, None], azimuths(settings.columns)[None]
    d = distance + torch.arange(settings.rows * settings.columns).view(settings.rows, -1) * 1e-3
    return torch.stack([d * azimuth.cos(), d * azimuth.sin(), d * elevation.tan()], -1).flatten(0, 1)


@pytest.mark.parametrize("settings", [SETTINGS, VLP16])
def test_there_and_back_is_exact_for_points_on_the_beams(settings: RangeImageSettings) -> None:
    """With one point per slot in the middle of its column, every slot is full and the points are restored to
    rounding."""
    points = points_of_beams(settings)
    image, mask = project(points, settings)
    assert image.shape == (2, settings.rows, settings.columns)
    assert mask.all()
    torch.testing.assert_close(to_points(image, settings.scale), points, atol=1e-4, rtol=0)


def test_rows_are_the_beams_of_the_simulated_sensor() -> None:
    """The default is rows 5 to 44 of a 64-beam sensor, as the synthetic one has them."""
    np.testing.assert_allclose(elevations(SETTINGS).numpy(), sensor_elevations(64)[5:45], atol=1e-6)


def test_points_of_a_slot_are_averaged() -> None:
    """Two points of one slot: mean of d and of z."""
    a = float(azimuths(256)[3])
    points = torch.tensor([[d * math.cos(a), d * math.sin(a), -0.1 * d] for d in (10.0, 10.4)])
    image, mask = project(points, SETTINGS)
    assert int(mask.sum()) == 1
    torch.testing.assert_close(image[:, mask][:, 0] * SETTINGS.scale, torch.tensor([10.2, -1.02]))


def test_what_does_not_belong_is_left_out() -> None:
    """Not finite, too near, too far, above the top row or below the bottom one; an intensity column is ignored."""
    bad = torch.tensor(
        [[math.nan, 1, 0, 0], [math.inf, 0, 0, 0], [1.0, 1, 0, 0], [121.0, 0, 0, 0], [20, 0, 2.0, 0], [20, 0, -9, 0]]
    )
    assert not project(bad, SETTINGS)[1].any()
    assert int(project(torch.cat([bad, torch.tensor([[20.0, 0, -1, 0.5]])]), SETTINGS)[1].sum()) == 1
    assert not project(torch.empty(0, 3), SETTINGS)[1].any()


def test_columns_begin_ahead_and_go_to_the_left() -> None:
    """A point just left of straight ahead is in column 0, one just right of it in the last column."""
    points = torch.tensor([[20.0, 0.01, -1], [20.0, -0.01, -1]])
    mask = project(points, SETTINGS)[1]
    assert mask.any(0).nonzero()[:, 0].tolist() == [0, 255]


def test_fill_takes_the_farthest_around_with_its_own_height_and_wraps() -> None:
    """By hand: two known slots near an empty one, and one across the border of the columns."""
    image, mask = torch.zeros(2, 6, 64), torch.zeros(6, 64, dtype=torch.bool)
    for row, column, d, z in ((2, 0, 0.5, 0.9), (2, 1, 0.7, -0.3)):
        image[:, row, column] = torch.tensor([d, z])
        mask[row, column] = True
    out = fill(image, mask)
    assert out[:, 2, 2].tolist() == pytest.approx([0.7, -0.3])  # d and z of the same point
    assert out[:, 2, 62].tolist() == pytest.approx([0.5, 0.9])  # two columns to the right of 0, around the circle
    assert out[:, 2, 0].tolist() == pytest.approx([0.5, 0.9])  # known: kept
    assert (out[0] > 0).all()


def test_fill_of_a_batch_is_that_of_each_and_an_empty_image_stays() -> None:
    """The filling of a batch ends, although one of its images can never be filled."""
    image, mask = project(points_of_beams(SETTINGS)[::7], SETTINGS)
    both = fill(torch.stack([image, 0 * image]), torch.stack([mask, torch.zeros_like(mask)]))
    torch.testing.assert_close(both[0], fill(image, mask))
    assert not both[1].any()


def test_gradient_of_the_points_reaches_d_and_z() -> None:
    """x and y depend on d only, z on z only; compared with finite differences in double."""
    image = torch.rand(1, 2, 2, 64, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: to_points(x, 120.0), image)


def test_settings_that_cannot_be_are_rejected() -> None:
    """More rows than beams, beams out of order, or columns that the networks cannot halve."""
    with pytest.raises(UsageError, match=r"rows 40 to 79 of a sensor with 64 beams"):
        project(torch.zeros(1, 3), RangeImageSettings(first=40))
    with pytest.raises(ValueError, match="below the one before"):
        RangeImageSettings(beams=((-8.0, 2.0, 64),))
    with pytest.raises(ValueError, match="columns"):
        RangeImageSettings(columns=100)
