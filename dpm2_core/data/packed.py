# SPDX-License-Identifier: Apache-2.0
"""Drives packed for training: cropped clouds as 2 mm integers, poses and small images, memory-mapped."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Camera, Image

QUANTUM = 0.002  # m; 60 m fit in 16 bits, and the LiDAR's noise is ten times as much
FORMAT = 1


class Sample(NamedTuple):
    """One frame: cloud (N, 3) float32 m, cropped; T_world_lidar (4, 4); images."""

    cloud: NDArray[np.float32]
    pose: Array
    images: tuple[Image, ...] = ()


def write_packed(folder: Path, samples: Sequence[Sample], about: dict[str, object]) -> None:
    """Write the drive; a killed run leaves nothing that looks whole.

    Every frame has the same number of images of the same size. `about` says where the drive is from.
    """
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    offsets = np.cumsum([0, *(len(s.cloud) for s in samples)])
    flat = np.concatenate([s.cloud for s in samples])
    np.save(part / "clouds.npy", np.round(flat / QUANTUM).clip(-32767, 32767).astype(np.int16))
    np.save(part / "offsets.npy", offsets)
    np.save(part / "poses.npy", np.stack([s.pose for s in samples]))
    if samples[0].images:
        np.save(part / "pixels.npy", np.stack([[image.pixels for image in s.images] for s in samples]))
        np.save(part / "K.npy", np.stack([[image.camera.K for image in s.images] for s in samples]))
        extrinsics = [[image.camera.T_lidar_cam for image in s.images] for s in samples]
        np.save(part / "T_lidar_cam.npy", np.stack(extrinsics))
    (part / "about.json").write_text(json.dumps({"format": FORMAT, **about}, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(part, folder)


class PackedDrive:
    """A packed drive, opened lazily: `poses` (n, 4, 4) in memory, the rest memory-mapped."""

    def __init__(self, folder: Path) -> None:
        try:
            self.about = json.loads((folder / "about.json").read_text())
            self.poses: Array = np.load(folder / "poses.npy", allow_pickle=False)
            self.offsets = np.load(folder / "offsets.npy", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise UsageError(f"{folder}: no packed drive: {error}") from None
        if self.about.get("format") != FORMAT:
            raise UsageError(f"{folder}: packed format {self.about.get('format')}, want {FORMAT}: pack it again")
        self.folder = folder
        self.name = folder.name
        self._maps: dict[str, NDArray] = {}

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int) -> Sample:
        start, end = self.offsets[index : index + 2]
        cloud = self._map("clouds")[start:end].astype(np.float32) * np.float32(QUANTUM)
        return Sample(cloud, self.poses[index], self._images(index))

    def _map(self, name: str) -> NDArray:
        if name not in self._maps:
            self._maps[name] = np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        return self._maps[name]

    def _images(self, index: int) -> tuple[Image, ...]:
        if not (self.folder / "pixels.npy").exists():
            return ()
        pixels, K, T = (self._map(name)[index] for name in ("pixels", "K", "T_lidar_cam"))
        return tuple(
            Image(np.array(p), Camera(np.array(k), np.array(t), (p.shape[1], p.shape[0])))
            for p, k, t in zip(pixels, K, T, strict=True)
        )


def open_packed(root: Path) -> list[PackedDrive]:
    """Every packed drive below `root`, by name.

    Raises:
        UsageError: there is none.
    """
    found = [PackedDrive(path.parent) for path in sorted(root.rglob("about.json")) if ".part" not in str(path)]
    if not found:
        raise UsageError(f"{root}: no packed drive below it; `dpm2 train pack` makes some")
    return found
