# SPDX-License-Identifier: Apache-2.0
"""A drive through the synthetic city as a source of frames that are simulated when they are asked for: no disk."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dpm2_core.data.prefetch import prefetch
from dpm2_core.frame import Array, Frame
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.sim.world import build_world

_STREAM = 12  # of random numbers, beside those of the other parts of a world


class SimulatedDrive:
    """A `data.source.Source`: the drive along a road, with traffic, at 10 Hz, LiDAR alone.

    Attributes:
        world: what it drives through. T_world_lidar: (N, 4, 4).
    """

    T_cam_lidar = None
    truth = "simulation"

    def __init__(self, road: str, preset: PresetName = "suburb", seed: int = 0, name: str = "") -> None:
        """`road`, `preset` and `seed` as in `build_world`, `name` what reports call it.

        Raises:
            UsageError: no such road or preset.
        """
        self.name = name or f"{road} {preset} {seed}"
        self.notes: list[str] = []
        self.world = build_world(road, preset, seed)
        self.times = self.world.road.times
        self._lidar = Lidar(LidarConfig())
        height = self._lidar.config.height
        self.T_world_lidar: Array = np.stack([self.world.drive_pose(float(t), height) for t in self.times])

    def __len__(self) -> int:
        return len(self.times)

    @property
    def poses(self) -> Array:
        """(N, 4, 4) T_world_lidar, exact."""
        return self.T_world_lidar

    def frame(self, i: int) -> Frame:
        """Frame i, the same whenever it is asked for."""
        time = float(self.times[i])
        rng = np.random.default_rng([self.world.seed, _STREAM, i])
        scan = self._lidar.scan(self.world, self.T_world_lidar[i], time, rng)
        return Frame(round(time * 1e9), scan.points, index=i)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1, simulated ahead in another thread."""
        return prefetch(map(self.frame, range(len(self))[start:stop]))
