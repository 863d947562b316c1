# SPDX-License-Identifier: Apache-2.0
"""Translation along a smooth tunnel from LiDAR intensities, and that nothing else in them is taken for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.data.open import open_source
from dpm2_core.estimates import State
from dpm2_core.frame import Array, Frame, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_odometry
from dpm2_core.slam.registration.intensity import IntensitySearch
from dpm2_core.slam.registration.texture import Peak
from dpm2_core.slam.settings import SlamSettings

_AHEAD = np.array([1.0, 0.0, 0.0])
_WIDTH, _FLOOR, _CEILING = 4.0, -1.7, 3.0  # m


class Tunnel:
    """Smooth walls with patches of random brightness, an end wall behind the start, and a LiDAR with 32 beams.

    Each beam has its own gain, and a bright line runs along either side of the floor: both move with the sensor.
    """

    def __init__(self, seed: int, spread: float, period: float = 1e3) -> None:
        """`spread`: standard deviation of the intensity from patch to patch. `period`: distance after which the patches
        repeat."""
        self._rng = np.random.default_rng(seed)
        self._patches = spread * self._rng.standard_normal((1 << 12, 64))
        self._period = period
        self._gain = self._rng.uniform(0.7, 1.3, 32)
        up, around = np.radians(np.linspace(-25, 15, 32)), np.linspace(-np.pi, np.pi, 720, endpoint=False)
        up, around = np.meshgrid(up, around, indexing="ij")
        self._rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], -1).reshape(-1, 3)

    def scan(self, at: float) -> Points:
        """Points (P, 4) within 40 m of a LiDAR that looks along the tunnel, `at` m from its end."""
        x, y, z = self._rays.T
        with np.errstate(divide="ignore"):
            ways = [_WIDTH / np.abs(y), np.where(z < 0, _FLOOR / z, _CEILING / z), np.where(x < 0, -at / x, np.inf)]
        surface = np.argmin(ways, 0)
        r = np.min(ways, 0) + self._rng.normal(0, 0.01, len(x))
        points = r[:, None] * self._rays
        along = np.floor((points[:, 0] + at) % self._period / 0.4).astype(int)
        beside = np.floor((points[:, 1] + 3 * points[:, 2]) / 0.4).astype(int)
        line = 0.3 * ((surface == 1) & (z < 0) & (np.abs(points[:, 1]) > 3.5))
        intensity = 0.3 + self._patches[along % len(self._patches), beside % 64] + line
        intensity = intensity * np.repeat(self._gain, 720) + self._rng.normal(0, 0.02, len(x))
        seen = r < 40
        return np.c_[points, intensity.clip(0, 1)][seen].astype(np.float32)


def _at(x: float) -> Array:
    return se3.exp(np.array([0, 0, 0, x, 0, 0]))


def _searched(tunnel: Tunnel, offset: float, reach: float, scans: int = 5) -> Peak | str:
    """Search result for a scan that is `offset` m farther along than assumed."""
    search = IntensitySearch()
    for i in range(scans):
        search.update(tunnel.scan(100 + 1.3 * i), _at(1.3 * i))
    return search.search(tunnel.scan(106.7 + offset), _at(6.7), _AHEAD, reach)


@pytest.mark.parametrize("offset", [-5.3, -0.42, 0.0, 0.25, 4.07])
def test_the_way_along_a_smooth_tunnel_is_found(offset: float) -> None:
    found = _searched(Tunnel(0, 0.06), offset, 6.0)
    assert isinstance(found, Peak), found
    # Patches of 0.4 m in cells of 0.1 m: 0.02 m of error in 40 of these cases, and twice that to allow for chance.
    assert abs(found.offset - offset) < min(0.05, 4 * found.sigma)


def test_beams_and_lines_that_stay_with_the_sensor_are_not_taken_for_a_halt() -> None:
    """Without patches, a scan contains only what moves with the sensor."""
    for seed in range(10):
        assert _searched(Tunnel(seed, 0.0), 1.3, 6.0) == "intensity: no place stands out"


def test_what_repeats_is_not_decided_by_chance() -> None:
    assert _searched(Tunnel(1, 0.06, period=4.0), 1.0, 6.0) == "intensity: several places are alike"
    found = _searched(Tunnel(1, 0.06, period=4.0), 1.0, 1.5)  # the prior motion decides
    assert isinstance(found, Peak)
    assert abs(found.offset - 1.0) < 0.05


def test_what_moves_with_the_sensor_must_be_known_first() -> None:
    assert _searched(Tunnel(0, 0.06), 0.3, 1.0, scans=4) == ""


@pytest.mark.parametrize("intensity", [0.0, 1.0, 1e30])
@pytest.mark.parametrize(
    ("every", "reason"),
    [(1, "no place stands out"), (2000, "too little is seen again"), (10**6, "too little is seen again")],
)
def test_where_intensities_or_points_are_missing_nothing_is_told(intensity: float, every: int, reason: str) -> None:
    search = IntensitySearch()
    scan = Tunnel(0, 0.06).scan(100.0)[every - 1 :: every]
    scan[:, 3] = intensity
    for i in range(6):
        search.update(scan, _at(i))
    assert search.search(scan, _at(6), _AHEAD, 6.0) == f"intensity: {reason}"


@pytest.mark.parametrize("half", [0.0, 0.5, 1.5])
def test_a_scan_that_shows_a_short_stretch_tells_nothing(half: float) -> None:
    """Then the random correlation is not known."""
    search, tunnel = IntensitySearch(), Tunnel(0, 0.06)

    def stretch(at: float) -> Points:
        points = tunnel.scan(at)
        return points[np.abs(points[:, 0]) <= half]

    for i in range(5):
        search.update(stretch(100 + 0.5 * i), _at(0.5 * i))
    assert search.search(stretch(102.5), _at(2.5), _AHEAD, 6.0) == "intensity: too little is seen again"


def _driven(tunnel: Tunnel, **settings: Any) -> tuple[list[State], Array]:
    """States (80,), and how far the odometry is ahead (80,), m. It moves 1 m from scan to scan, with a halt in
    between."""
    way = np.concatenate([[0.0], np.cumsum(np.interp(np.arange(79), [20, 40, 50, 70], [1.0, 0, 0, 1.0]))])
    odometry = make_odometry(SlamSettings.model_validate({"registration": "geometric", **settings}))
    tracks = [odometry.process(Frame(i * 10**8, tunnel.scan(60 + x), index=i)) for i, x in enumerate(way)]
    return [track.state for track in tracks], np.array([track.T_odom_lidar[0, 3] for track in tracks]) - way


def test_an_odometry_starts_in_a_tunnel_without_a_camera_and_stops_there_and_goes() -> None:
    """The first scans show what moves with the sensor. After that the translation is known at any speed."""
    states, ahead = _driven(Tunnel(2, 0.06))
    assert states[8:].count(State.TRACKING) >= 70  # of 72
    assert np.ptp(ahead[8:]) < 0.3  # over 40 m
    without, wrong = _driven(Tunnel(2, 0.06), visual={"enabled": False})
    assert np.ptp(wrong[8:]) > 3
    assert State.TRACKING not in without


def test_without_texture_it_says_so() -> None:
    states, _ = _driven(Tunnel(2, 0.0))
    assert State.TRACKING not in states


def test_the_surface_of_a_real_road_tells_the_way(kitti_root: Path) -> None:
    """KITTI 04, with points within 0.25 m of the road. The search covers 6 m, every 1.4 m."""
    source, search, rng, errors = (
        open_source(kitti_root / "sequences" / "04"),
        IntensitySearch(),
        np.random.default_rng(0),
        [],
    )
    poses = source.poses
    assert poses is not None
    for frame, T in zip(source.frames(), poses, strict=True):
        road = frame.points[np.abs(frame.points[:, 2] + 1.73) < 0.25]
        offset = rng.uniform(-4, 4)
        found = search.search(road, T @ _at(-offset), _AHEAD, 6.0)
        if isinstance(found, Peak):
            errors.append(abs(found.offset - offset))
        search.update(road, T)
    assert len(errors) >= 30  # 39 of 46
    assert max(errors) < 0.1  # 0.077 m; the poses have an error of a centimeter or two from scan to scan
