# SPDX-License-Identifier: Apache-2.0
"""Preprocessing of a scan: only valid measurements, deskewed to one time, downsampled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_core.config import load_settings
from dpm2_core.errors import UsageError
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.deskew import deskew
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings


def test_keeps_only_measurements_within_range() -> None:
    points = np.array(
        [[x, 0, 0, 0.5] for x in (np.nan, np.inf, 0, 1, 5, 100, 1e30)],
        np.float32,
    )  # fmt: skip
    points.flags.writeable = False  # read-only, as in messages
    scan = Preprocessor(PreprocessSettings()).prepare(Frame(0, points), np.zeros(6))
    np.testing.assert_array_equal(scan.cloud, points[4:5])
    np.testing.assert_array_equal(scan.source, points[4:5, :3])


def test_an_empty_cloud_stays_empty() -> None:
    scan = Preprocessor(PreprocessSettings()).prepare(Frame(0, np.zeros((0, 4), np.float32)), np.zeros(6))
    assert scan.cloud.shape == (0, 4)
    assert scan.source.shape == (0, 3)


def test_impossible_settings_are_rejected() -> None:
    with pytest.raises(UsageError, match="min_range < max_range"):
        load_settings(PreprocessSettings, overrides=["min_range=100"])
    with pytest.raises(UsageError, match="map_voxel <= source_voxel"):
        load_settings(PreprocessSettings, overrides=["map_voxel=2"])


@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6), st.floats(0.0, 0.1))
def test_deskewing_undoes_a_constant_velocity(twist: list[float], earliest: float) -> None:
    """Deskewing restores a wall that a moving sensor saw, each point in the frame of its own time."""
    rng = np.random.default_rng(0)
    motion = np.array(twist) * [0.5, 0.5, 0.5, 15, 15, 15]
    at_stamp = rng.uniform(-30, 30, (500, 3))
    time = rng.uniform(-earliest, 0.1 - earliest, 500)
    T_moment_stamp = se3.inverse(se3.exp(time[:, None] * motion))
    seen = np.einsum("nij,nj->ni", T_moment_stamp[:, :3, :3], at_stamp) + T_moment_stamp[:, :3, 3]
    points = np.c_[seen, np.ones(500)].astype(np.float32)
    undone = deskew(points, time.astype(np.float32), motion)
    # 64 poses in 0.1 s: half a step of 0.8 ms at up to 26 m/s and 0.87 rad/s, 52 m away, is 5.6 cm
    assert np.abs(undone[:, :3] - at_stamp).max() < 0.06
    np.testing.assert_array_equal(undone[:, 3], 1)
