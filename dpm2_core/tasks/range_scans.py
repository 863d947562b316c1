# SPDX-License-Identifier: Apache-2.0
"""Scans as range images, for the tasks that learn on them, and how clouds made from images are evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dpm2_core.diffslam.trajectory_loss import SlamLoss
from dpm2_core.errors import UsageError
from dpm2_core.network.perception.range_image import RangeImageSettings, fill, project, to_points
from dpm2_core.tasks.pairs import SCALE, ImageScan
from dpm2_core.tasks.scan import TaskScan

_MAX_CACHED_SCANS = 2000
"""Scans whose images are cached: about 180 kB each, and projecting one takes as long as half a step of training."""


@dataclass(frozen=True, eq=False)
class RangeScans:
    """B scans.

    Attributes:
        images: (B, 2, rows, columns) filled, in units of `scale`, m. masks: (B, rows, columns), where there was a
            point. frames: (sequence, number) of each.
    """

    images: Tensor
    masks: Tensor
    frames: list[tuple[str, int]]
    scale: float

    def part(self, begin: int, end: int) -> RangeScans:
        """A range of these scans."""
        chosen = slice(begin, end)
        return replace(self, images=self.images[chosen], masks=self.masks[chosen], frames=self.frames[chosen])

    def with_images(self, images: Tensor) -> RangeScans:
        """Other images in the same slots, such as a network's output for these."""
        return replace(self, images=images)

    def off(self, true: RangeScans) -> Tensor:
        """Absolute errors of the distances over ground, m: (B, rows, columns)."""
        return (self.images - true.images)[:, 0].abs() * self.scale

    def clouds(self) -> list[Tensor]:
        """The points (N_b, 3), m, of the slots that had one."""
        points = to_points(self.images, self.scale)
        return [cloud[mask.flatten()] for cloud, mask in zip(points, self.masks, strict=True)]


class RangeReader:
    """Makes range images of scans, and caches the latest ones if requested."""

    def __init__(self, settings: RangeImageSettings) -> None:
        """Images of that geometry."""
        self._settings = settings
        self._cache: dict[tuple[str, int, bool], tuple[Tensor, Tensor]] = {}

    def read(self, scans: Sequence[TaskScan], static: bool = False, keep: bool = False) -> RangeScans:
        """The scans, or their twins without moving objects.

        Args:
            keep: cache the images. Scans are identified by sequence and number, so only those of one data set may be
                cached.

        Raises:
            UsageError: a scan has no twin, or is an image of other rows and columns. A scan without any point in the
                image is no error: this happens next to a truck, and all its slots are empty.
        """
        pairs = [self._cached_image(scan, static) if keep else self._make_image(scan, static) for scan in scans]
        frames = [(scan.sequence, scan.number) for scan in scans]
        images, masks = (torch.stack(list(part)) for part in zip(*pairs, strict=True))
        return RangeScans(images, masks, frames, self._settings.scale)

    def _cached_image(self, scan: TaskScan, static: bool) -> tuple[Tensor, Tensor]:
        key = (scan.sequence, scan.number, static)
        if key not in self._cache:
            if len(self._cache) >= 2 * _MAX_CACHED_SCANS:
                self._cache.pop(next(iter(self._cache)))
            self._cache[key] = self._make_image(scan, static)
        return self._cache[key]

    def _make_image(self, scan: TaskScan, static: bool) -> tuple[Tensor, Tensor]:
        where = f"{scan.sequence}, scan {scan.number}"
        if static and scan.static is None:
            raise UsageError(f"{where}: no static twin")
        if isinstance(scan, ImageScan):
            image, mask = (scan.static_image, scan.static_mask) if static else (scan.image, scan.mask)
            return self._crop_stored(image, mask, where)
        points = scan.static if static and scan.static is not None else scan.points
        image, mask = project(points, self._settings)
        return fill(image, mask), mask

    def _crop_stored(self, image: Tensor, mask: Tensor, where: str) -> tuple[Tensor, Tensor]:
        """The rows from `first` on, and the number of columns in the settings, evenly spaced."""
        s, (rows, columns) = self._settings, mask.shape
        if rows < s.first + s.rows or columns % s.columns:
            raise UsageError(
                f"{where}: an image of {rows} x {columns} has no rows {s.first} to {s.first + s.rows - 1}, "
                f"or its columns are not a multiple of {s.columns}"
            )
        step = columns // s.columns
        image, mask = image[:, s.first :, ::step][:, : s.rows], mask[s.first :, ::step][: s.rows]
        image = image * (SCALE / s.scale)
        in_range = image[0] < 1  # as in `project`: a network cannot output distances beyond the scale
        return fill(image * in_range, in_range), mask & in_range


def image_error(output: Tensor, true: Tensor) -> Tensor:
    """Sum of the absolute errors of an image (B, 2, rows, columns), the mean over the images; a scalar."""
    return (output - true).abs().sum((1, 2, 3)).mean()


def slam_of(slam_loss: SlamLoss, output: Tensor, true: RangeScans, windows: Sequence[slice]) -> Tensor:
    """SLAM loss of images (B, 2, rows, columns) against the true ones, m2; the mean over the windows.

    Slots that are empty in the true scan do not count.
    """
    found, requested = to_points(output, true.scale), to_points(true.images, true.scale)
    weights = true.masks.flatten(1).to(output)
    values = []
    for part in windows:
        w = weights[part]
        values.append(slam_loss(found[part], requested[part], w, w, frames=true.frames[part]))
    return torch.stack(values).mean()


def variety(scans: Sequence[RangeScans]) -> float:
    """How much the distances differ from scan to scan: their standard deviation in a slot, m, the mean over the slots.
    Zero if a network makes the same image of every scan."""
    distances = torch.cat([part.images[:, 0] for part in scans])
    return float(distances.std(0, correction=0).mean()) * scans[0].scale
