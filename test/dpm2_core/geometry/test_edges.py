# SPDX-License-Identifier: Apache-2.0
"""Vertical edges: what counts as one, how far apart they are, that they are detected again, and scans without edges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpm2_core.data.kitti import KittiSource
from dpm2_core.geometry import se3
from dpm2_core.geometry.edges import HEIGHT, SPACING, spaced, vertical_edges, verticality
from dpm2_core.geometry.point_grid import PointGrid
from dpm2_core.geometry.sampling import Points, farthest_points, interleaved
from dpm2_core.network.pyramid import build_pyramid, crop
from dpm2_core.network.settings import preset

POLES = np.array([[8.0, 4.0], [-11.0, 6.0], [3.0, -14.0], [20.0, -9.0], [-6.0, -8.0]])


def ground() -> Points:
    """A square of 60 m, 1.7 m below the sensor, with a point every 0.4 m."""
    x, y = np.meshgrid(np.arange(-30, 30, 0.4), np.arange(-30, 30, 0.4))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.7)], 1).astype(np.float32)


def poles(step: float, noise: np.random.Generator) -> Points:
    """Poles 5 m high, with a point every `step` m and 1 cm of noise."""
    z = np.arange(-1.7, 3.3, step)
    at = [np.column_stack([np.tile(pole, (len(z), 1)), z]) for pole in POLES]
    points = np.concatenate(at)
    return (points + noise.normal(0, 0.01, points.shape)).astype(np.float32)


def wall() -> Points:
    """A wall 20 m long and 5 m high, along x, with a point every 0.3 m."""
    x, z = np.meshgrid(np.arange(-10, 10, 0.3), np.arange(-1.7, 3.3, 0.3))
    return np.stack([x.ravel(), np.full(x.size, 18.0), z.ravel()], 1).astype(np.float32)


def edges_of(cloud: Points, most: int = 128) -> Points:
    return vertical_edges(cloud, PointGrid(cloud.astype(float), 1.5), most)


def horizontally(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Horizontal distance of each point of a to the nearest point of b."""
    return np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=2).min(1)


def test_poles_are_found_first(noise: np.random.Generator) -> None:
    """Next to a wall and on ground: every pole is found, to 10 cm, before any point on the wall, and none on the
    ground."""
    cloud = np.concatenate([ground(), wall(), poles(0.3, noise)])
    result = edges_of(cloud)
    assert result.dtype == np.float32
    on_pole = horizontally(result, POLES) < 0.25  # the ground at its foot is among a pole's neighbors
    assert horizontally(POLES, result).max() < 0.1
    assert on_pole[: 4 * len(POLES)].all()  # each is long enough for four points
    np.testing.assert_array_equal(result[:, 2] % HEIGHT, 0)
    assert (np.abs(result[~on_pole, 1] - 18) < 0.1).all()
    between = np.linalg.norm(result[:, None] - result, axis=2) + np.eye(len(result)) * 9
    assert between.min() >= SPACING
    assert np.array_equal(edges_of(cloud, 3), result[:3])


@pytest.mark.parametrize("rise", [0.0, 0.2])
def test_found_again_from_elsewhere(noise: np.random.Generator, rise: float) -> None:
    """After a rotation and a translation, the same points on the poles are found, no farther off than the ground is
    higher."""
    cloud = np.concatenate([ground(), poles(0.3, noise)])
    T = se3.exp([0, 0, 2.0, 7.0, -3.0, rise])
    one, other = edges_of(cloud), edges_of(se3.transform(T, cloud).astype(np.float32))
    apart = cKDTree(other).query(se3.transform(T, one))[0]
    assert apart.max() < rise + 0.1  # noise of a centimeter, and the ground at the foot
    assert abs(len(one) - len(other)) <= len(POLES)


def test_places_on_a_leaning_edge_lie_on_it(noise: np.random.Generator) -> None:
    """They are moved along the edge, not vertically: on a pole that leans by 10 degrees, each is within 3 cm of its
    axis."""
    lean = np.tan(np.radians(10))
    cloud = poles(0.3, noise)
    cloud[:, 0] += lean * cloud[:, 2]
    result = edges_of(np.concatenate([ground(), cloud]))
    inside = result[(result[:, 2] > -1) & (result[:, 2] < 3)]
    assert len(inside) >= 3 * len(POLES)
    foot = inside - np.column_stack([lean * inside[:, 2], np.zeros((len(inside), 2))])
    assert horizontally(foot, POLES).max() < 0.03


@pytest.mark.parametrize(
    "cloud",
    [ground(), wall() * [1, 1, 0.15], np.zeros((0, 3)), np.ones((50, 3)), poles(0.3, np.random.default_rng(0))[:3]],
)
def test_nothing_vertical_gives_none(cloud: np.ndarray) -> None:
    """Ground, a curb, no points, one position, too few points."""
    assert edges_of(cloud.astype(np.float32)).shape == (0, 3)


def test_sparse_beams_give_none(noise: np.random.Generator) -> None:
    """A pole that is hit every 0.7 m, as by 16 beams at 20 m, is too uncertain: farthest points are used there."""
    assert len(edges_of(np.concatenate([ground(), poles(0.7, noise)]))) == 0
    assert len(edges_of(np.concatenate([ground(), poles(0.4, noise)]))) >= len(POLES)


def test_verticality_is_that_of_the_eigenvectors(noise: np.random.Generator) -> None:
    """Compared with `eigh`. A line has 1 or 0, depending on its direction, and a point 0."""
    local = noise.normal(size=(200, 16, 3)) * noise.uniform(0.01, 1, (200, 1, 3))
    local -= local.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(local.transpose(0, 2, 1) @ local / 16)
    s = np.sqrt(values)
    expected = (s[:, 2] - s[:, 1]) / s[:, 2] * np.abs(vectors[:, 2, 2])
    np.testing.assert_allclose(verticality(local), expected, atol=1e-6)
    line = np.zeros((3, 16, 3))
    line[0, :, 2] = line[1, :, 0] = np.linspace(-1, 1, 16)
    np.testing.assert_allclose(verticality(line), [1, 0, 0], atol=1e-6)


@pytest.mark.parametrize("n", [0, 1, 2, 600])
def test_spacing_is_that_of_one_after_the_other(noise: np.random.Generator, n: int) -> None:
    """The rounds return the same as a sequential loop."""
    points = noise.uniform(0, 12, (n, 3)).astype(np.float32)
    stays: list[int] = []
    for i, point in enumerate(points):
        if all(np.linalg.norm(point - points[j]) > SPACING for j in stays):
            stays.append(i)
    assert spaced(points, SPACING, len(points)).tolist() == stays
    assert spaced(points, SPACING, 5).tolist() == stays[:5]


@pytest.mark.parametrize(("n", "k", "first"), [(100, 0, 40), (100, 20, 40), (100, 13, 40), (30, 15, 40), (40, 40, 40)])
def test_any_prefix_holds_the_mixture(n: int, k: int, first: int) -> None:
    """Both kinds keep their order, and every prefix of the first points has the same ratio of them, to one point."""
    points, special = np.zeros((n, 3), np.float32), np.ones((k, 3), np.float32)
    points[:, 1], special[:, 1] = np.arange(n), np.arange(k)
    out = interleaved(points, special, first)
    is_special = out[:, 0] == 1
    assert out[is_special, 1].tolist() == list(range(k))
    assert out[~is_special, 1].tolist() == list(range(n - k))
    first = min(n, first)
    assert not is_special[first:].any()
    assert np.abs(is_special[:first].cumsum() - k / first * np.arange(1, first + 1)).max() <= 1


def test_farthest_points_take_the_place_of_missing_edges(noise: np.random.Generator) -> None:
    """Reference points alternate between edges and farthest points. On bare ground they are only farthest points."""
    salient, farthest = (preset("small", {"fusion": {"reference": kind}}) for kind in ("salient", "fps"))
    assert np.array_equal(build_pyramid(ground(), salient).xyz, build_pyramid(ground(), farthest).xyz)
    cloud = np.concatenate([ground(), poles(0.3, noise)])
    edges = edges_of(cloud)
    pyramid, plain = build_pyramid(cloud, salient), build_pyramid(cloud, farthest)
    of_edge = (pyramid.xyz[:, None] == edges).all(2).any(1)
    assert of_edge.sum() == of_edge[: salient.fusion.points].sum() == len(edges)
    assert of_edge[: salient.fusion.points // 2].sum() == pytest.approx(len(edges) / 2, abs=1)
    assert np.array_equal(pyramid.xyz[~of_edge], plain.xyz[: pyramid.count - len(edges)])


def test_edges_of_real_scans_meet_again(kitti_root: Path) -> None:
    """4 m farther along KITTI 04, eight times as many edges as farthest points are within 0.4 m of one of the other
    scan."""
    sequence = KittiSource(kitti_root / "sequences" / "04")
    settings = preset("small").points
    frames = list(sequence.frames())
    one, other = (crop(frames[i].points, settings) for i in (10, 13))
    T = se3.inverse(sequence.poses[10]) @ sequence.poses[13]

    def met(a: Points, b: Points) -> float:
        return float((cKDTree(a).query(se3.transform(T, b))[0] < 0.4).mean())

    edges = met(edges_of(one), edges_of(other))
    assert edges > 0.4
    farthest = [cloud[farthest_points(cloud, 256, PointGrid(cloud.astype(float), 1.5))] for cloud in (one, other)]
    assert edges > 8 * met(*farthest)
