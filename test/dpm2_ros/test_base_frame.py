# SPDX-License-Identifier: Apache-2.0
"""The frame whose pose is published, for any order of /tf_static: the requested one, or one without a parent."""

from __future__ import annotations

from itertools import accumulate, permutations

import numpy as np
import pytest

from dpm2_core.data.transforms import TransformTree
from dpm2_core.geometry import se3
from dpm2_ros.base_frame import BaseFrame

LINKS = {
    ("sensor", "lidar"): se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
    ("base", "sensor"): se3.exp([0.0, -0.1, 0.2, 1.0, 0.0, 1.5]),
    ("footprint", "base"): se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.2]),
    ("base", "camera"): se3.exp([0.0, 0.0, 1.0, 0.0, 0.3, 0.2]),
}
ORDERS = list(permutations(LINKS))


def trees(order: tuple[tuple[str, str], ...]) -> list[TransformTree]:
    """The transform trees after none, one, two, ... of the links."""
    out = []
    for known in [(), *accumulate((link,) for link in order)]:
        out.append(TransformTree())
        for link in known:
            out[-1].set(*link, LINKS[link])
    return out


@pytest.mark.parametrize("order", ORDERS)
def test_a_base_that_was_asked_for_is_known_once_it_is_reachable(order: tuple[tuple[str, str], ...]) -> None:
    base, reachable = BaseFrame("base", ("odom",)), {("sensor", "lidar"), ("base", "sensor")}
    for n, tree in enumerate(trees(order)):
        base.look(tree, "lidar")
        assert bool(base.name) == (reachable <= set(order[:n]))
        assert bool(base.problem) == (not base.name)
    np.testing.assert_allclose(base.T_start_lidar, LINKS["base", "sensor"] @ LINKS["sensor", "lidar"])
    np.testing.assert_array_equal(base.T_base_start, np.eye(4))


@pytest.mark.parametrize("order", ORDERS)
def test_without_one_it_never_has_a_parent_and_its_pose_is_consistent(order: tuple[tuple[str, str], ...]) -> None:
    base = BaseFrame("", ("odom",))
    whole = trees(order)[-1]
    for tree in trees(order):
        base.look(tree, "/lidar")
        assert base.name == tree.root("lidar")
        T_base_lidar = base.T_base_start @ base.T_start_lidar
        expected = np.eye(4) if base.name == "lidar" else whole.lookup(base.name, "lidar")
        np.testing.assert_allclose(T_base_lidar, expected, atol=1e-12)
        np.testing.assert_array_equal(base.T_start_lidar, np.eye(4))  # odom stays where it was
    base.restart()
    np.testing.assert_array_equal(base.T_base_start, np.eye(4))
    np.testing.assert_allclose(base.T_start_lidar, whole.lookup("footprint", "lidar"), atol=1e-12)


@pytest.mark.parametrize("wanted", ["base", ""])
def test_a_lidar_that_is_moved_in_its_base_counts_from_the_next_drive_on(wanted: str) -> None:
    """If a calibration is corrected while the node runs, the drive keeps its extrinsics and the mismatch is reported;
    the next drive uses the new ones."""
    base, moved = BaseFrame(wanted, ("odom",)), "/tf_static has moved the LiDAR in base: ~/reset applies its new pose"
    for x in (1.0, 1.8):
        tree = TransformTree()
        tree.set("base", "lidar", se3.make(np.eye(3), [x, 0, 0]))
        base.look(tree, "lidar")
        assert base.T_start_lidar[0, 3] == 1.0
        assert base.problem == ("" if x == 1.0 else moved)
    base.restart()
    assert (base.T_start_lidar[0, 3], base.problem) == (1.8, "")
    np.testing.assert_array_equal(base.T_base_start, np.eye(4))


def test_the_place_of_another_lidar_is_not_that_of_the_first() -> None:
    """For another LiDAR there is no base until /tf_static contains that LiDAR."""
    base, tree = BaseFrame("base", ("odom",)), TransformTree()
    tree.set("base", "lidar", se3.make(np.eye(3), [1.0, 0, 0]))
    assert base.look(tree, "lidar")
    base.forget()
    assert not base.look(tree, "rear")
    assert (base.name, bool(base.problem)) == ("", True)
    tree = tree.copy()
    tree.set("base", "rear", se3.make(np.eye(3), [-1.5, 0, 0]))
    assert base.look(tree, "rear")
    assert (base.name, base.problem, base.T_start_lidar[0, 3]) == ("base", "", -1.5)


def test_a_base_below_another_frame_names_the_one_that_may_be_moved() -> None:
    """If `ros.base_frame` has a parent, the frame to use instead is named, since two parents would break /tf, also if
    the parent arrives late. The pose is known nevertheless."""
    early, late = BaseFrame("base", ("odom",)), BaseFrame("base", ("odom",))
    *_, three, whole = trees(tuple(LINKS)[:3])
    assert early.look(whole, "lidar")
    assert late.look(three, "lidar")
    assert late.child_problem == ""
    assert not late.look(whole, "lidar")
    for base in (early, late):
        assert (base.name, base.problem) == ("base", "")
        assert base.child_problem.endswith("set ros.base_frame to footprint")


def test_a_frame_that_this_node_moves_is_no_base() -> None:
    """If map -> odom -> base is published as static, odom is not the base: odom -> map would be a cycle."""
    tree = TransformTree()
    for parent, child in (("map", "odom"), ("odom", "base"), ("base", "lidar")):
        tree.set(parent, child, np.eye(4))
    base = BaseFrame("", ("odom", "map"))
    base.look(tree, "lidar")
    assert base.name == "base"


def test_the_lidar_itself_may_be_asked_for() -> None:
    base = BaseFrame("/lidar", ())
    assert base.look(TransformTree(), "lidar")
    assert (base.name, base.problem) == ("lidar", "")
