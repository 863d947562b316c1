# SPDX-License-Identifier: Apache-2.0
"""The transform tree: any pair of connected frames, and never an identity for frames that are not connected."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpm2_core.data.transforms import TransformTree
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array
from dpm2_core.geometry import se3


def pose(seed: int) -> Array:
    return se3.exp(np.random.default_rng(seed).normal(size=6))


def message(parent: str, child: str, T: Array, scale: float = 1.0) -> SimpleNamespace:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat() * scale
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=SimpleNamespace(frame_id=parent),
                child_frame_id=child,
                transform=SimpleNamespace(
                    translation=SimpleNamespace(**dict(zip("xyz", T[:3, 3], strict=True))),
                    rotation=SimpleNamespace(x=x, y=y, z=z, w=w),
                ),
            )
        ]
    )


def test_lookup_goes_up_and_down_the_tree() -> None:
    tree = TransformTree()
    tree.add(message("base_link", "velo", pose(1)))
    tree.add(message("/base_link", "/mast", pose(2), scale=2.0))  # tf1 names; the quaternion is not of unit length
    tree.set("mast", "camera", pose(3))
    np.testing.assert_allclose(tree.lookup("velo", "camera"), se3.inverse(pose(1)) @ pose(2) @ pose(3), atol=1e-12)
    np.testing.assert_allclose(tree.lookup("base_link", "camera"), pose(2) @ pose(3), atol=1e-12)
    np.testing.assert_allclose(tree.lookup("camera", "mast"), se3.inverse(pose(3)), atol=1e-12)
    np.testing.assert_array_equal(tree.lookup("velo", "velo"), np.eye(4))
    tree.set("mast", "camera", pose(4))
    np.testing.assert_allclose(tree.lookup("mast", "camera"), pose(4), atol=1e-12)


@pytest.mark.parametrize(("target", "source"), [("velo", "camera"), ("velo", "absent"), ("absent", "absent"), ("", "")])
def test_unconnected_frames_are_an_error_that_names_all(target: str, source: str) -> None:
    tree = TransformTree()
    tree.set("base", "velo", pose(1))
    tree.set("rig", "camera", pose(2))
    with pytest.raises(UsageError, match=f"'{source}' to '{target}'; frames known: base, camera, rig, velo"):
        tree.lookup(target, source)


def test_a_cycle_does_not_hang() -> None:
    tree = TransformTree()
    tree.set("a", "b", pose(1))
    tree.set("b", "a", pose(2))
    with pytest.raises(UsageError, match="frames known: a, b"):
        tree.lookup("a", "c")


@pytest.mark.parametrize(("scale", "x"), [(0.0, 0.0), (1.0, np.nan)])
def test_no_rigid_transform_is_named_and_left_out(scale: float, x: float) -> None:
    T, tree = pose(1), TransformTree()
    T[0, 3] = x
    (problem,) = tree.add(message("base", "velo", T, scale))
    assert problem.startswith("tf base -> velo: no rigid transform")
    assert tree.frames == []
