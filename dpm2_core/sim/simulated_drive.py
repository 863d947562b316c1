# SPDX-License-Identifier: Apache-2.0
"""A drive through the synthetic city as a source of frames that are simulated when they are asked for: no disk."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

import numpy as np

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

    def __init__(
        self,
        road: str,
        preset: PresetName = "suburb",
        seed: int = 0,
        lidar: LidarConfig | None = None,
        workers: int = 1,
        name: str = "",
        traffic: float = 1.0,
    ) -> None:
        """`road`, `preset`, `seed` and `traffic` as in `build_world`, `name` what reports call it.

        Raises:
            UsageError: no such road or preset.
        """
        self.name = name or f"{road} {preset} {seed}"
        self.notes: list[str] = []
        self.world = build_world(road, preset, seed, traffic=traffic)
        self.times = self.world.road.times
        self._lidar = Lidar(lidar or LidarConfig())
        self._workers = workers
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
        """Frames start..stop-1, simulated some frames ahead in other threads."""
        requested = iter(range(start, len(self) if stop is None else min(stop, len(self))))
        with ThreadPoolExecutor(self._workers, thread_name_prefix="sim") as pool:
            ahead: deque[Future[Frame]] = deque(
                pool.submit(self.frame, i) for i in islice(requested, 2 * self._workers)
            )
            while ahead:
                frame = ahead.popleft().result()
                ahead.extend(pool.submit(self.frame, i) for i in islice(requested, 1))
                yield frame
