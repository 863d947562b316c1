# SPDX-License-Identifier: Apache-2.0
"""The point pyramid of a raw scan, which the backbone reads: sampling and neighbor search, once, in numpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpm2_core.errors import Dpm2Error
from dpm2_core.frame import Image
from dpm2_core.geometry.corners import TEXTURE, Corners, image_corners, no_corners
from dpm2_core.geometry.edges import vertical_edges
from dpm2_core.geometry.point_grid import PointGrid
from dpm2_core.geometry.sampling import farthest_points, interleaved, neighbours
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.network.images import small_image
from dpm2_core.network.settings import NetworkSettings, PointsSettings

MIN_POINTS = 32  # a scan with fewer points does not determine the pose


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Levels of one scan; the points of a level are a prefix of those of the level before.

    Attributes:
        xyz: (n_0, 3) float32 m, farthest-first, the reference points as `fusion.reference` says; zeros after `count`.
        count: valid points of the first level; that of level i is min(count, n_i).
        patches: (n_0, k_0, 3) float16 m, input points around each first-level point, relative to it.
        groups: per further level (n_i, k_i) int16, neighbors in the level before.
        locals: per level, per residual block (n_i, k) int16, neighbors in the level itself.
        ups: per feature propagation, coarse to fine, (n_fine, 3) int16, the nearest points of the coarser level.
        texture: (n, TEXTURE) float16 of the reference points that are image corners, zeros for the others.
    """

    xyz: NDArray[np.float32]
    count: int
    patches: NDArray[np.float16]
    groups: tuple[NDArray[np.int16], ...]
    locals: tuple[tuple[NDArray[np.int16], ...], ...]
    ups: tuple[NDArray[np.int16], ...]
    texture: NDArray[np.float16]


class PointBatch(NamedTuple):
    """A batch of pyramids as tensors, fields as in `Pyramid` with a leading dimension B; `valid` (B,) is its count."""

    xyz: Tensor
    valid: Tensor
    patches: Tensor
    groups: tuple[Tensor, ...]
    locals: tuple[tuple[Tensor, ...], ...]
    ups: tuple[Tensor, ...]
    texture: Tensor


def crop(points: NDArray[np.float32], settings: PointsSettings) -> NDArray[np.float32]:
    """Range crop and voxel grid of (N, 3+) points: (M, 3), sorted by x, so that the order of a cloud with one point per
    voxel does not matter; of several points the first is kept.
    """
    xyz = points[voxel_first(points, settings.voxel, settings.near, settings.far), :3]
    return xyz[np.argsort(xyz[:, 0])]


def build_pyramid(cloud: NDArray[np.float32], network: NetworkSettings, images: Sequence[Image] = ()) -> Pyramid:
    """The pyramid of a cropped (M, 3) cloud, and of its images if reference points may be their corners.

    Raises:
        Dpm2Error: fewer than `MIN_POINTS` points.
    """
    settings = network.points
    if len(cloud) < MIN_POINTS:
        raise Dpm2Error(f"scan has {len(cloud)} points within {settings.near}-{settings.far} m, want {MIN_POINTS}")
    stages = settings.stages
    first = stages[0]
    grid = _grid(cloud, first.radius / 1.5)  # most neighborhoods are full before the radius
    xyz, texture = _sample_points(cloud, grid, network, images)
    count = len(xyz)
    index = neighbours(grid, xyz, first.neighbours, first.radius)
    patches = np.zeros((first.points, first.neighbours, 3), np.float16)
    patches[:count] = cloud[index] - xyz[:, None]

    grid_radii = [*(stage.radius for stage in stages[1:]), stages[-1].radius]
    grids = [_grid(xyz[: stage.points], radius) for stage, radius in zip(stages, grid_radii, strict=True)]
    groups = tuple(
        _padded(neighbours(grids[i], xyz[: stage.points], stage.neighbours, stage.radius), stage.points)
        for i, stage in enumerate(stages[1:])
    )
    locals_ = tuple(
        tuple(
            _padded(neighbours(grid, xyz[: stage.points], stage.residual_neighbours, radius), stage.points)
            for radius in stage.residual_radii
        )
        for grid, stage in zip(grids, stages, strict=True)
    )
    ups = tuple(
        _padded(neighbours(grids[i + 1], xyz[: stages[i].points], 3, np.inf), stages[i].points)
        for i in range(len(stages) - 2, len(stages) - 2 - settings.upsample, -1)
    )
    padded_xyz = np.zeros((first.points, 3), np.float32)
    padded_xyz[:count] = xyz
    return Pyramid(padded_xyz, count, patches, groups, locals_, ups, texture.astype(np.float16))


def _sample_points(
    cloud: NDArray[np.float32], grid: PointGrid, network: NetworkSettings, images: Sequence[Image]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The points (N, 3) of the first level, the reference points first, and the texture of these."""
    fusion = network.fusion
    xyz = cloud[farthest_points(cloud, network.points.stages[0].points, grid)]
    texture = np.zeros((max(len(xyz), fusion.points), TEXTURE), np.float32)
    if fusion.reference == "salient":
        references = min(fusion.points, len(xyz))
        corners = _find_corners(cloud, images, network, int(fusion.corners * references))
        others = references - len(corners.xyz)
        xyz = interleaved(xyz, vertical_edges(cloud, grid, int(fusion.edges * others)), others)
        xyz = interleaved(xyz, corners.xyz, references)
        texture[: len(xyz)] = interleaved(texture[: len(xyz)], corners.texture, references)
    return xyz, texture[: fusion.points]


def _find_corners(
    cloud: NDArray[np.float32], images: Sequence[Image], network: NetworkSettings, max_corners: int
) -> Corners:
    """Corners of all images, the same limit for each; none for a network without a camera."""
    if network.image.backbone == "none" or not images or max_corners < len(images):
        return no_corners()
    found = []
    for image in images:
        small = small_image(image, network.image)
        found.append(
            image_corners(small.pixels, small.camera.K, small.camera.T_lidar_cam, cloud, max_corners // len(images))
        )
    return Corners(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _grid(points: NDArray[np.float32], radius: float) -> PointGrid:
    return PointGrid(points.astype(np.float64), radius)


def _padded(index: NDArray[np.int64], rows: int) -> NDArray[np.int16]:
    out = np.zeros((rows, index.shape[1]), np.int16)
    out[: len(index)] = index
    return out


def collate(pyramids: list[Pyramid]) -> PointBatch:
    """Stack pyramids of one configuration."""

    def index(arrays: list[NDArray[np.int16]]) -> Tensor:
        return torch.from_numpy(np.stack(arrays)).long()

    return PointBatch(
        torch.from_numpy(np.stack([p.xyz for p in pyramids])),
        torch.tensor([p.count for p in pyramids]),
        torch.from_numpy(np.stack([p.patches for p in pyramids])).float(),
        tuple(index(list(level)) for level in zip(*(p.groups for p in pyramids), strict=True)),
        tuple(
            tuple(index(list(block)) for block in zip(*levels, strict=True))
            for levels in zip(*(p.locals for p in pyramids), strict=True)
        ),
        tuple(index(list(level)) for level in zip(*(p.ups for p in pyramids), strict=True)),
        torch.from_numpy(np.stack([p.texture for p in pyramids])).float(),
    )
