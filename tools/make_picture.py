# SPDX-License-Identifier: Apache-2.0
"""The animated image of the README (APNG; `make picture`).

Each drive is processed by the SLAM; the image shows the growing map, seen from above, and the trajectory. The image
contains no other data of a drive.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from dpm2_core.commands.options import run_command
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.extras import needs
from dpm2_core.files import atomic_write
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.settings import SlamSettings

SIZE = (420, 320)
"""Width and height of each drive's part, pixels."""
MOMENTS = 44
"""Number of images in the animation."""
MAX_SIZE = 3_000_000
"""Largest size of the file, bytes."""
# m around the trajectory, m between points, ms of the last image.
_MARGIN, _SPACING, _LAST_IMAGE_DURATION = 25.0, 0.35, 2000
_BACKGROUND, _HEIGHT_RANGE = (16, 21, 26), (0.0, 5.0)  # RGB; m above the lowest points, between which colors change

Picture = NDArray[np.uint8]


def moments(drive: Path, title: str) -> list[Picture]:
    """The map at `MOMENTS` times of a drive, (height, width, 3) RGB each."""
    source = open_source(drive, InputSettings(images=False))
    slam = make_slam(SlamSettings())
    poses, clouds = [], []
    for frame in source.frames():
        result = slam.process(frame).odometry
        poses.append(result.T_odom_lidar)
        near = frame.points[np.einsum("ij,ij->i", frame.points[:, :2], frame.points[:, :2]) < 40.0**2]
        near = near[voxel_first(near, _SPACING)]
        clouds.append(se3.transform(result.T_odom_lidar, near)[:, :3].astype(np.float64))
    if len(poses) < 2:
        raise UsageError(f"{drive}: want a drive of two frames or more")
    positions = np.array([T[:3, 3] for T in poses])
    view = _View(positions)
    counts = [int(n) for n in np.linspace(1, len(poses), MOMENTS)]
    images, before = [], 0
    for count in counts:
        for cloud in clouds[before:count]:
            view.add(cloud)
        before = count
        images.append(view.draw(positions[:count], f"{title}: {count} of {len(poses)} scans"))
    return images


class _View:
    """A map from above, rotated so that its longer side is along the longer side of the image."""

    def __init__(self, positions: NDArray[np.float64]) -> None:
        middle = positions[:, :2].mean(0)
        axes = np.linalg.svd(positions[:, :2] - middle)[2]
        if np.linalg.det(axes) < 0:
            axes[1] *= -1
        local = (positions[:, :2] - middle) @ axes.T
        low, high = local.min(0) - _MARGIN, local.max(0) + _MARGIN
        self._axes, self._middle = axes, middle + (low + high) / 2 @ axes
        self._scale = float(min(np.array(SIZE) / (high - low)))
        self._height = np.full(SIZE[::-1], -np.inf, np.float32)
        self._floor = float(positions[:, 2].min()) - 2.0

    def pixels(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) column and row."""
        local = (xy - self._middle) @ self._axes.T * self._scale
        return np.column_stack([SIZE[0] / 2 + local[:, 0], SIZE[1] / 2 - local[:, 1]])

    def add(self, points: NDArray[np.float64]) -> None:
        """Add points (N, 3) to the map: each pixel keeps the highest."""
        pixel = np.floor(self.pixels(points[:, :2])).astype(int)
        inside = ((pixel >= 0) & (pixel < SIZE)).all(1)
        np.maximum.at(
            self._height, (pixel[inside, 1], pixel[inside, 0]), points[inside, 2].astype(np.float32) - self._floor
        )

    def draw(self, positions: NDArray[np.float64], text: str) -> Picture:
        """The image, RGB."""
        height = np.clip((self._height - _HEIGHT_RANGE[0]) / (_HEIGHT_RANGE[1] - _HEIGHT_RANGE[0]), 0, 1)
        height = np.round(np.where(np.isfinite(height), height, 0) * 12) / 12  # few colors: a small file
        is_seen = np.isfinite(self._height)[..., None]
        color = np.array([60, 85, 115]) * (1 - height[..., None]) + np.array([240, 225, 190]) * height[..., None]
        image = np.ascontiguousarray(np.where(is_seen, color, _BACKGROUND).astype(np.uint8))
        line = np.round(self.pixels(positions[:, :2])).astype(np.int32)
        cv2.polylines(image, [line], False, (255, 150, 40), 2)
        cv2.circle(image, [int(v) for v in line[-1]], 4, (255, 255, 255), -1)
        cv2.putText(image, text, (8, SIZE[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1)
        return image


def write_apng(path: Path, images: list[Picture]) -> None:
    """Write all images in sequence, the last one shown longer; at most `MAX_SIZE` bytes.

    Raises:
        Dpm2Error: it is larger, or could not be written.
    """
    with needs("plot", "drawing"):
        from PIL import Image

    reduced = [Image.fromarray(image).quantize(48, dither=Image.Dither.NONE) for image in images]
    durations = [110] * (len(reduced) - 1) + [_LAST_IMAGE_DURATION]
    with atomic_write(path, "wb") as file:
        first, *others = reduced
        first.save(file, "PNG", save_all=True, append_images=others, duration=durations, loop=0, optimize=True)
        if file.tell() > MAX_SIZE:
            raise Dpm2Error(f"{path}: {file.tell() / 1e6:.1f} MB, more than {MAX_SIZE / 1e6:g}")


def make_picture(
    out: Annotated[Path, typer.Argument(metavar="OUT.png")],
    drives: Annotated[list[str], typer.Argument(metavar="[TITLE=]DRIVE...")],
) -> None:
    """Draw drives side by side."""
    parts = []
    for argument in drives:
        title, _, drive = argument.rpartition("=")
        parts.append(moments(Path(drive), title or Path(drive).name))
    write_apng(out, [np.hstack(images) for images in zip(*parts, strict=True)])


if __name__ == "__main__":
    sys.exit(run_command(make_picture))
