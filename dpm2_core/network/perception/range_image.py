# SPDX-License-Identifier: Apache-2.0
"""Range images: a scan as rows of beams and columns of azimuth, each slot the distance over ground d and the height z.

After Caccia et al., "Deep Generative Modeling of LiDAR Data" (IROS 2019) and DSLR (AAAI 2021).
"""

from __future__ import annotations

import math

import torch
from pydantic import Field, field_validator
from torch import Tensor
from torch.nn import functional

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError

CHANNELS = 2
"""Channels of an image: d = sqrt(x^2 + y^2) and z, both in units of `scale`."""
_FILL_RADIUS = 2  # slots on each side that one step of filling covers: a 5 x 5 pool


class RangeImageSettings(Settings):
    """Geometry of a range image; the default is the upper part of a 64-beam sensor, 40 x 256 as in the papers."""

    beams: tuple[tuple[float, float, int], ...] = ((2.0, -8.33, 32), (-8.83, -24.8, 32))
    """Groups of evenly spaced beams from the top: elevation of the first and the last, deg, and their number.
    VLP-16: ((15, -15, 16),)."""
    first: int = Field(default=5, ge=0)
    """Beam of the top row."""
    rows: int = Field(default=40, ge=4)
    """Beams of the image."""
    columns: int = Field(default=256, ge=64, multiple_of=64)
    """Slots of a revolution, from straight ahead to the left."""
    scale: float = Field(default=120.0, gt=0)
    """Distance that is one in the image, m; points farther away are not used."""
    min_distance: float = Field(default=2.65, gt=0)
    """Points nearer than this, over ground, are not used, m."""

    @field_validator("beams")
    @classmethod
    def _check_descending(cls, beams: tuple[tuple[float, float, int], ...]) -> tuple[tuple[float, float, int], ...]:
        angles = [angle for top, bottom, count in beams for angle in ((top, bottom) if count > 1 else (top,))]
        if not angles or min(count for *_, count in beams) < 1 or sorted(set(angles), reverse=True) != angles:
            raise ValueError("want groups (first deg, last deg, count), each beam below the one before")
        return beams


def elevations(settings: RangeImageSettings) -> Tensor:
    """(rows,) elevation of the rows of the image, rad, the top one first.

    Raises:
        UsageError: the sensor has fewer beams than `first + rows`.
    """
    all_beams = torch.cat([torch.linspace(top, bottom, count) for top, bottom, count in settings.beams])
    rows = torch.deg2rad(all_beams[settings.first : settings.first + settings.rows])
    if len(rows) < settings.rows:
        last = settings.first + settings.rows - 1
        raise UsageError(f"range image: rows {settings.first} to {last} of a sensor with {len(all_beams)} beams")
    return rows


def azimuths(columns: int) -> Tensor:
    """(columns,) azimuth of the center of each column, rad."""
    return (torch.arange(columns) + 0.5) * (2 * math.pi / columns)


def slots(points: Tensor, settings: RangeImageSettings) -> tuple[Tensor, Tensor]:
    """Index (N,) of the slot of each point, row by row, and whether it is in the image at all (N,) bool.

    Points that are not finite, too near, too far, or above or below the rows are outside.

    Args:
        points: (N, 3+) m, of any dtype.
    """
    beams = elevations(settings).to(points)
    d = torch.hypot(points[:, 0], points[:, 1])
    inside = points[:, :3].isfinite().all(1) & (d >= settings.min_distance) & (d < settings.scale)
    elevation = torch.atan2(points[:, 2], d)
    boundaries = (beams[1:] + beams[:-1]) / 2
    above, below = beams[0] - boundaries[0], boundaries[-1] - beams[-1]  # half the spacing to a beam beyond the image
    inside &= (elevation <= beams[0] + above) & (elevation > beams[-1] - below)
    row = torch.searchsorted(-boundaries, -elevation.nan_to_num())
    revolution = torch.remainder(torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi), 1).nan_to_num()
    return row * settings.columns + (revolution * settings.columns).long().clamp(max=settings.columns - 1), inside


def project(points: Tensor, settings: RangeImageSettings) -> tuple[Tensor, Tensor]:
    """Image (2, rows, columns), zero in slots without a point, and (rows, columns) bool, the slots with one.

    For several points in a slot the mean of d and z is used. Points outside the image are left out, see `slots`.

    Args:
        points: (N, 3+) m, of any dtype.
    """
    rows, columns = settings.rows, settings.columns
    slot, inside = slots(points, settings)
    points, slot = points[inside], slot[inside]
    d = torch.hypot(points[:, 0], points[:, 1])
    total = points.new_zeros(CHANNELS, rows * columns)
    total.index_add_(1, slot, torch.stack([d, points[:, 2]]) / settings.scale)
    count = points.new_zeros(rows * columns).index_add_(0, slot, torch.ones_like(d))
    return (total / count.clamp(min=1)).view(CHANNELS, rows, columns), (count > 0).view(rows, columns)


def fill(image: Tensor, mask: Tensor) -> Tensor:
    """The image (..., 2, R, C) in which every empty slot has the values of the farthest of the slots around it.

    A 5 x 5 maximum over d is repeated until no slot is empty; z is from the same slot, and the columns are a circle. An
    image without any point stays zero.

    Args:
        mask: (..., R, C) bool, false where a slot is empty.
    """
    shape, (R, C) = image.shape, image.shape[-2:]
    image, mask = image.reshape(-1, CHANNELS, R, C), mask.reshape(-1, 1, R, C)
    while bool((~mask & mask.flatten(1).any(1)[:, None, None, None]).any()):
        d, z = (_wrap_columns(channel.masked_fill(~mask, -torch.inf)) for channel in image.split(1, 1))
        farthest, index = functional.max_pool2d(d, 2 * _FILL_RADIUS + 1, 1, (_FILL_RADIUS, 0), return_indices=True)
        height = z.flatten(2).gather(2, index.flatten(2)).view_as(farthest)
        found = ~mask & farthest.isfinite()
        image = torch.where(found, torch.cat([farthest, height], 1), image)
        mask = mask | found
    return image.view(shape)


def to_points(image: Tensor, scale: float) -> Tensor:
    """Points (..., R * C, 3), m, of images (..., 2, R, C) by the fixed azimuth of their columns; differentiable.

    Args:
        scale: distance of a value of one, m.
    """
    angle = azimuths(image.shape[-1]).to(image)
    d, z = image[..., 0, :, :], image[..., 1, :, :]
    return scale * torch.stack([d * angle.cos(), d * angle.sin(), z], -1).flatten(-3, -2)


def _wrap_columns(channel: Tensor) -> Tensor:
    """(B, 1, R, C), padded at each end with the columns of the other end."""
    return torch.cat([channel[..., -_FILL_RADIUS:], channel, channel[..., :_FILL_RADIUS]], -1)
