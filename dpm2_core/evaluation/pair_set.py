# SPDX-License-Identifier: Apache-2.0
"""Registration of fixed frame pairs of unseen worlds: it shows what limits a network, and which checkpoint is best."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.distance import pdist

from dpm2_core.data.packed import open_packed
from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.network.images import in_encoded_axes
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.packed_frames import check_fits, fitted
from dpm2_core.network.pyramid import build_pyramid, collate
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.views import collate_views

NEAR, FAR = 5.0, 20.0  # m, between the frames of a pair
SUCCESS = (0.6, 1.5)
"""Errors of a registration, m and deg, below which it is a success."""


def has_pair(poses: Array, low: float, high: float) -> bool:
    """Whether two of (N, 4, 4) poses are between `low` and `high` apart, m; poses that are NaN are ignored."""
    distance = pdist(poses[:, :3, 3])
    return bool(((distance > low) & (distance <= high)).any())


class PairSet:
    """Pairs drawn once: half up to 5 m apart, half 5 to `farthest` m, two of four with a randomly rotated source.

    Raises:
        UsageError: no two frames of a drive are this far apart, or the network needs more of them than was packed.
    """

    def __init__(self, root: Path, pairs: int, network: NetworkSettings, images: bool, farthest: float = FAR) -> None:
        rng = np.random.default_rng(0)
        self.drives = open_packed(root)
        self.network, self.images = network, images
        for drive in self.drives:
            check_fits(drive, network, images)
        self.frames: dict[tuple[int, int, float], int] = {}
        self.pairs: list[tuple[int, int, np.ndarray, float]] = []
        self._scale: list[float] = []
        bounds = (0.0, NEAR), (NEAR, farthest)
        for low, high in bounds:
            if not any(has_pair(drive.poses, low, high) for drive in self.drives):
                raise UsageError(
                    f"{root}: no two frames of a drive are {low:g} to {high:g} m apart, which are measured"
                )
        while len(self.pairs) < pairs:
            d = int(rng.integers(len(self.drives)))
            poses = self.drives[d].poses
            a = int(rng.integers(len(poses)))
            distance = np.linalg.norm(poses[:, :3, 3] - poses[a, :3, 3], axis=1)
            low, high = bounds[len(self.pairs) % 2]
            others = np.flatnonzero((distance > low) & (distance <= high))
            if len(others) == 0:
                continue
            b = int(rng.choice(others))
            yaw = float(rng.uniform(-np.pi, np.pi)) if len(self.pairs) % 4 >= 2 else 0.0
            T_turned_lidar = se3.exp([0, 0, yaw, 0, 0, 0])
            T = se3.inverse(poses[b]) @ poses[a] @ se3.inverse(T_turned_lidar)
            self.pairs.append((self._frame_number(d, a, yaw), self._frame_number(d, b, 0.0), T, float(distance[b])))
            self._scale.append(float(self.drives[d].about.get("scale", 1.0)))

    def _frame_number(self, drive: int, index: int, yaw: float) -> int:
        return self.frames.setdefault((drive, index, yaw), len(self.frames))

    @torch.inference_mode()
    def encode(self, model: DeepPointMap2) -> list[Descriptors]:
        """Descriptors of every frame of the set."""
        keys = list(self.frames)
        out: list[Descriptors] = []
        for begin in range(0, len(keys), 8):
            pyramids, images = [], []
            for drive, index, yaw in keys[begin : begin + 8]:
                sample = fitted(self.drives[drive][index], self.drives[drive], self.network.points)
                T_turned_lidar = se3.exp([0, 0, yaw, 0, 0, 0])
                R = T_turned_lidar[:3, :3]
                images.append([in_encoded_axes(image, R, 1.0) for image in sample.images] if self.images else [])
                pyramids.append(build_pyramid(se3.transform(T_turned_lidar, sample.cloud), self.network, images[-1]))
            out += model.encoder.encode_batch(collate(pyramids), collate_views(images, self.network.image))
        return out

    def errors(self, model: DeepPointMap2) -> np.ndarray:
        """Per pair: distance m, rotated (0, 1), translation error m, rotation error deg, squared Mahalanobis error."""
        descriptors = self.encode(model)
        rows = []
        for begin in range(0, len(self.pairs), 16):
            chunk = self.pairs[begin : begin + 16]
            results = model.register_many([descriptors[p[0]] for p in chunk], [descriptors[p[1]] for p in chunk])
            for i, ((_, _, T, distance), result) in enumerate(zip(chunk, results, strict=True), begin):
                xi = se3.way(result.T_target_source, T)
                error = np.linalg.norm(result.T_target_source[:3, 3] - T[:3, 3])
                squared = xi @ np.linalg.solve(result.covariance, xi)
                rows.append((distance, i % 4 >= 2, error, np.degrees(np.linalg.norm(xi[:3])), squared))
        return np.array(rows)

    def measure(self, model: DeepPointMap2) -> dict[str, float]:
        """Medians and success rates of near and far pairs, and of rotated ones; kinds without a pair are left out.

        Rooms are packed enlarged. Distances and the limits of a success are enlarged, too; medians are m of the room.
        """
        rows = self.errors(model)
        meters = rows[:, 2] / np.array(self._scale)
        near = rows[:, 0] <= NEAR
        is_success = (rows[:, 2] < SUCCESS[0]) & (rows[:, 3] < SUCCESS[1])
        out = {}
        for name, chosen in (("near", near), ("far", ~near), ("turned", rows[:, 1] > 0)):
            if not chosen.any():
                continue
            out[f"{name}_m"] = float(np.median(meters[chosen]))
            out[f"{name}_deg"] = float(np.median(rows[chosen, 3]))
            out[f"{name}_success"] = float(is_success[chosen].mean())
        out["chi2"] = float(np.median(rows[is_success, 4])) if is_success.any() else float("nan")
        return out
