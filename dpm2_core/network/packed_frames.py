# SPDX-License-Identifier: Apache-2.0
"""Frames of packed drives, adapted to a network: they were cropped, and their images resized, for another one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.packed import PackedDrive, Sample
from dpm2_core.errors import UsageError
from dpm2_core.network.pyramid import crop
from dpm2_core.network.settings import NetworkSettings, PointsSettings

_CROP = ("near", "far", "voxel")


def crop_of(points: PointsSettings) -> dict[str, float]:
    """The settings that `crop` uses, for the `about` of a packed drive."""
    return {name: getattr(points, name) for name in _CROP}


def check_fits(drive: PackedDrive, network: NetworkSettings, images: bool) -> None:
    """Raise UsageError if a network needs more than was packed, in the clouds or, with `images`, in the images."""
    packed, wanted = _packed_crop(drive), crop_of(network.points)
    for name in _CROP:
        shortfall = wanted[name] - packed[name] if name == "far" else packed[name] - wanted[name]
        if shortfall > 0:
            raise UsageError(
                f"{drive.folder}: packed with points.{name} {packed[name]:g}, but the network has {wanted[name]:g}:"
                " the packed clouds lack points"
            )
    if images:
        check_images(drive, network)


def _packed_crop(drive: PackedDrive) -> dict[str, float]:
    return drive.about.get("crop", crop_of(PointsSettings()))  # without an entry: packed with that of the presets


def check_images(drive: PackedDrive, network: NetworkSettings) -> None:
    """Raise UsageError if the images of a drive are smaller than those that the network reads."""
    (height, width), packed = network.image.size, drive.image_size
    if network.image.backbone != "none" and packed is not None and (packed[0] < height or packed[1] < width):
        raise UsageError(
            f"{drive.folder}: packed with images of {packed[0]} x {packed[1]}, but the network has {height} x {width}"
            " (image.size); pack it with the network's --preset"
        )


def fitted(sample: Sample, drive: PackedDrive, points: PointsSettings) -> Sample:
    """A sample of a drive for a network, which may need less of its cloud than was packed."""
    if _packed_crop(drive) == crop_of(points):
        return sample
    return sample._replace(cloud=cropped_anew(sample.cloud, points))


def cropped_anew(cloud: NDArray[np.float32], points: PointsSettings) -> NDArray[np.float32]:
    """A packed cloud (N, 3), cropped for another network. Packed clouds are sorted by x, so the points are shuffled:
    the first point of a voxel would otherwise always be the rearmost one."""
    return crop(np.random.default_rng(0).permutation(cloud), points)
