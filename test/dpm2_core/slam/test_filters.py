# SPDX-License-Identifier: Apache-2.0
"""Filters of the scan: the rest of the SLAM uses only the remaining points. With wrong weights the SLAM does not
start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dpm2_core.data.open import open_source
from dpm2_core.errors import UsageError
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.network.perception.dslr import Dslr, DslrSettings
from dpm2_core.network.perception.dynamic_objects import DynamicObjectNetSettings
from dpm2_core.network.perception.gndnet import GroundNet, GroundSettings
from dpm2_core.network.pretrained import DYNAMIC
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.filters import (
    FilterKind,
    FilterSettings,
    in_level_axes,
    make_filter,
    without_dynamic_objects,
    without_ground,
    without_traffic,
)
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tasks.dynamic_objects_task import DynamicObjectTask, DynamicObjectTraining
from dpm2_core.tasks.training import save_task


@pytest.fixture
def points() -> np.ndarray:
    """(5000, 4): level ground 1.733 m below the sensor, and the first 1000 points up to 2 m above it."""
    rng = np.random.default_rng(0)
    out = rng.uniform(-15, 15, (5000, 4)).astype(np.float32)
    out[:, 2] = -1.733
    out[:1000, 2] += rng.uniform(0.5, 2, 1000).astype(np.float32)
    return out


class _High:
    """Stand-in for a `DynamicObjectNet`. Points above `height` are dynamic; the probability is `base` at 0 m and grows
    with height."""

    def __init__(self, height: float, base: float) -> None:
        self.height, self.base = height, base

    def probability(self, points: np.ndarray) -> np.ndarray:
        return (points[:, 2] > self.height).astype(np.float32) * (self.base + 0.1 * points[:, 2])


def test_dynamic_objects_are_left_out_but_never_more_than_the_limit(points: np.ndarray) -> None:
    net = _High(-1.0, DYNAMIC + 0.05)
    left = without_dynamic_objects(net, points)  # type: ignore[arg-type]
    np.testing.assert_array_equal(left, ~(net.probability(points) > DYNAMIC))
    assert (left & (points[:, 2] > -1)).any()  # points with a lower probability
    some = points[without_dynamic_objects(_High(-9.0, 0.6), points)]  # type: ignore[arg-type]
    assert 0.3 * len(points) <= len(some) < len(points)  # all points are likely dynamic
    assert some[:, 2].max() < points[:, 2].max()  # the most likely ones are removed first
    assert len(without_dynamic_objects(_High(0.0, 0.6), points[:0])) == 0  # type: ignore[arg-type]


@pytest.mark.parametrize("angles", [(0.0, 0.5), (-0.4, 0.0), (0.0, 0.0)], ids=["pitch", "roll", "level"])
def test_a_tilted_sensor_is_filtered_in_level_axes(points: np.ndarray, angles: tuple[float, float]) -> None:
    """The ground in the scan shows the tilt: the filter removes the same points as for a level sensor. The scan of a
    level sensor is passed on unchanged."""
    seen: list[np.ndarray] = []

    def above(scan: np.ndarray) -> np.ndarray:
        seen.append(scan)
        return np.asarray(scan[:, 2] > -1.5)

    tilted = se3.transform(se3.exp([*angles, 0, 0, 0, 0]), points).astype(np.float32)
    np.testing.assert_array_equal(in_level_axes(above, tilted), above(points))
    assert seen[0].dtype == np.float32
    assert any(angles) or seen[0] is tilted
    assert len(in_level_axes(above, points[:0])) == 0


@pytest.mark.weights
@pytest.mark.parametrize("kind", ["movers", "ground"])
def test_what_is_left_out_does_not_depend_on_the_mount(recording: Path, kind: FilterKind) -> None:
    """A street, seen with the sensor tilted 20 degrees down. Of all points that are removed from either scan, 97 % are
    removed from both. Filtered in the axes of the LiDAR, it is 2 and 7 %."""
    scan = next(iter(open_source(recording).frames())).points
    leaves = make_filter(FilterSettings(kind=kind), 1)
    assert leaves is not None
    tilted = se3.transform(se3.exp([0, np.radians(20), 0, 0, 0, 0]), scan).astype(np.float32)
    out, out_tilted = ~leaves(scan), ~leaves(tilted)
    assert (out & out_tilted).sum() > 0.8 * (out | out_tilted).sum()


@pytest.mark.slow
def test_ground_is_left_out(points: np.ndarray) -> None:
    """With a network whose output is zero everywhere, the ground lies where the sensor's height puts it."""
    net = GroundNet(GroundSettings(cells=32, channels=4)).eval()
    with torch.no_grad():
        for parameter in net.head.parameters():
            parameter.zero_()
    np.testing.assert_array_equal(points[without_ground(net, points)], points[:1000])


def test_what_stands_in_front_of_the_static_scan_is_left_out(points: np.ndarray) -> None:
    """The network returns a static scan that is 12 m away everywhere. It removes points in the image that are nearer
    than 0.8 of this distance, less 1 m."""
    net = Dslr(DslrSettings()).eval()
    net.forward = lambda images: torch.full_like(images, 12 / 120)  # type: ignore[method-assign]
    gone = points[~without_traffic(net, points)]
    assert 0 < len(gone) < len(points)
    assert np.hypot(gone[:, 0], gone[:, 1]).max() <= 0.8 * 12 - 1 + 1e-4
    assert len(without_traffic(net, points[:0])) == 0


def test_cloud_source_and_measured_are_what_the_filter_leaves(points: np.ndarray) -> None:
    settings, times = PreprocessSettings(scatter=1), points[:, 0] / 100  # random points look like dust
    scan = Preprocessor(settings, lambda scan: scan[:, 2] > -1.5).prepare(Frame(0, points, times), np.zeros(6))
    assert len(scan.points) > 900
    assert min(scan.points[:, 2].min(), scan.cloud[:, 2].min(), scan.source[:, 2].min()) > -1.5
    np.testing.assert_allclose(scan.times, scan.source[:, 0] / 100, atol=1e-8)  # each point has its own time
    np.testing.assert_allclose(scan.seen, scan.source, atol=1e-5)  # at rest


def test_weights_in_the_home_folder_are_found_by_its_sign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As for the weights of the descriptors: no shell expands `~` in the settings."""
    task = DynamicObjectTask(DynamicObjectTraining(network=DynamicObjectNetSettings(cells=32, cell=1.0, channels=4)))
    save_task(task, tmp_path / "mine.safetensors", {})
    monkeypatch.setenv("HOME", str(tmp_path))
    assert make_filter(FilterSettings(kind="movers", weights=Path("~/mine.safetensors")), 1) is not None


@pytest.mark.slow
def test_a_slam_with_a_filter_runs_and_tells_what_is_missing(tmp_path: Path, points: np.ndarray) -> None:
    task = DynamicObjectTask(DynamicObjectTraining(network=DynamicObjectNetSettings(cells=32, cell=1.0, channels=4)))
    path = tmp_path / "movers.safetensors"
    save_task(task, path, {})
    slam = make_slam(SlamSettings(filter=FilterSettings(kind="movers", weights=path), threads=1))
    assert [slam.process(Frame(i * 10**8, points)).odometry.registration.ok for i in range(3)] == [True] * 3
    assert make_filter(FilterSettings(), 1) is None
    with pytest.raises(UsageError, match="weights of movers, not of gndnet"):
        make_filter(FilterSettings(kind="ground", weights=path), 1)
    with pytest.raises(UsageError, match=r"slam\.filter\.weights: no such file .*dpm2 train dslr"):
        make_filter(FilterSettings(kind="static", weights=tmp_path / "none.safetensors"), 1)
