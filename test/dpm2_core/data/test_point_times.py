# SPDX-License-Identifier: Apache-2.0
"""Point times: units, origins, and invalid times."""

from __future__ import annotations

import numpy as np
import pytest

from dpm2_core.data import messages
from dpm2_core.data.messages import MessageError
from test.helpers.messages import STAMP, cloud, xyz

RAMP = np.linspace(0, 0.1, 5)


@pytest.mark.parametrize(
    ("name", "value", "want", "tolerance"),
    [
        ("t", (RAMP * 1e9).astype(np.uint32), RAMP, 1e-8),  # Ouster
        ("offset_time", (RAMP * 1e9).astype(np.uint32), RAMP, 1e-8),  # Livox CustomMsg
        ("time_offset_ns", (RAMP * 1e9).astype(np.int32), RAMP, 1e-8),
        ("timestamp_ns", STAMP + RAMP * 1e9, RAMP, 1e-6),
        ("ts", RAMP.astype(np.float32), RAMP, 1e-8),
        ("point_time", RAMP, RAMP, 1e-8),
        ("Time_us", (RAMP * 1e6).astype(np.uint32), RAMP, 1e-6),
        ("t_sec", RAMP, RAMP, 1e-8),
        ("time", RAMP.astype(np.float32), RAMP, 1e-8),  # Velodyne
        ("time", (RAMP - 0.1).astype(np.float32), RAMP - 0.1, 1e-8),  # stamped at the end of the sweep
        ("t", (RAMP * 1e6).astype(np.uint32), RAMP, 1e-6),
        ("time_stamp", (RAMP * 1e3).astype(np.float32), RAMP, 1e-6),
        ("timestamp", STAMP * 1e-9 + RAMP, RAMP, 1e-6),  # Hesai: epoch in s; a double resolves 0.24 us there
        ("timestamp", STAMP + RAMP * 1e9, RAMP, 1e-6),  # Livox PointCloud2: epoch in ns
        ("timestamp", STAMP * 1e-3 + RAMP * 1e6, RAMP, 1e-6),
        ("timestamp", 7200.0 + RAMP, RAMP, 1e-6),  # clock of the sensor since power-on
        ("t", np.uint32([1_800_000_000, 1_800_050_000, 1_800_100_000]), [0, 0.05, 0.1], 1e-6),  # us of the hour
    ],
)
def test_time_units_and_origins(name: str, value: np.ndarray, want: np.ndarray, tolerance: float) -> None:
    _, time = messages.decode_points(cloud(xyz(len(value), **{name: value})))
    assert time.dtype == np.float32
    np.testing.assert_allclose(time, want, atol=tolerance)


def test_times_that_tell_nothing() -> None:
    constant = cloud(xyz(3, t=np.uint32([7, 7, 7])))
    assert messages.decode_points(constant)[1] is None
    named = cloud(xyz(3, sweep=np.float32([0, 0.5, 1])))
    assert messages.decode_points(named)[1] is None
    assert messages.decode_points(cloud(xyz(3, t=np.float32([0, 0.5, 1]))), time_field="")[1] is None
    _, time = messages.decode_points(named, time_field="sweep", time_unit="ms")
    np.testing.assert_allclose(time, [0, 5e-4, 1e-3], rtol=1e-6)
    with pytest.raises(MessageError, match="no time field t; fields: x, y, z, sweep"):
        messages.decode_points(named, time_field="t")


def test_a_unit_in_the_name_outweighs_the_span() -> None:
    """Returns of a scan of 1 ms, the first of a sensor that was just switched on. By the span alone, the unit would be
    s."""
    ramp = np.float64([0, 0.5, 1.0])
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(3, time_ms=ramp)))[1], ramp * 1e-3, atol=1e-9)
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(3, time_ms=ramp)), time_unit="s")[1], ramp, atol=1e-9)


@pytest.mark.parametrize(
    ("columns", "reason"),
    [({}, "no time field"), ({"ring": np.uint8([1, 2, 3])}, "no time field"),
     ({"status": np.uint8([0, 1, 2])}, "no time field"), ({"T": np.uint32([7, 7, 7])}, "all points have the same T")],
)  # fmt: skip
def test_why_there_are_no_times_is_said(columns: dict[str, np.ndarray], reason: str) -> None:
    msg = cloud(xyz(3, **columns))
    assert messages.decode_points(msg)[1] is None
    assert messages.why_untimed(msg) == reason


def test_few_points_take_the_unit_of_their_type() -> None:
    """Two points 1 us apart: the span shows nothing. An integer is then in ns and a float in s."""
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(2, t=np.uint32([0, 1000]))))[1], [0, 1e-6])
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(2, t=np.float32([0, 1e-6]))))[1], [0, 1e-6])
    stamps = STAMP * 1e-9 + np.array([0, 1e-6])
    np.testing.assert_allclose(messages.decode_points(cloud(xyz(2, t=stamps)))[1], [0, 1e-6], atol=3e-7)


def test_missing_returns_do_not_spoil_the_times() -> None:
    columns = xyz(4, timestamp=STAMP * 1e-9 + np.array([0, 0.05, 0, 0.1]))
    columns["timestamp"][2] = 0.0  # as drivers leave it
    for name in "xyz":
        columns[name][2] = np.nan
    points, time = messages.decode_points(cloud(columns))
    assert np.isnan(points[2, :3]).all()
    np.testing.assert_allclose(time, [0, 0.05, 0, 0.1], atol=1e-6)


@pytest.mark.parametrize("began", [5.0, STAMP * 1e-9])
def test_a_time_of_zero_among_absolute_ones_means_nothing(began: float) -> None:
    """For example a missing return whose point was transformed into the vehicle's frame; with a sensor clock or UTC."""
    _, clean = messages.decode_points(cloud(xyz(4, timestamp=began + np.array([0, 0.05, 0.07, 0.1]))))
    _, time = messages.decode_points(cloud(xyz(5, timestamp=np.append(began + np.array([0, 0.05, 0.07, 0.1]), 0.0))))
    np.testing.assert_array_equal(time, np.append(clean, 0))
    _, relative = messages.decode_points(cloud(xyz(4, time=np.array([0, 0.03, 0.06, 0.1], np.float32))))
    np.testing.assert_allclose(relative, [0, 0.03, 0.06, 0.1])


@pytest.mark.parametrize("unit", ["s", "ns"])
@pytest.mark.parametrize("began", [0.05, 0.3, 1.0, 1.7, 2.5])
def test_absolute_times_of_a_clock_that_has_just_begun(began: float, unit: str) -> None:
    """As in a simulation, for layouts of Hesai, RoboSense and Livox. Taken as relative times, they put points 1.7 s
    off."""
    ramp, stamp = np.linspace(0, 0.1, 200), round(began * 1e9)
    for first in (0.0, -0.1) if began > 0.1 else (0.0,):  # stamped at its first or its last point
        time = (began + first + ramp) * (1e9 if unit == "ns" else 1)
        _, offset = messages.decode_points(cloud(xyz(200, timestamp=time), stamp))
        np.testing.assert_allclose(offset, first + ramp, atol=1e-6)
        _, offset = messages.decode_points(cloud(xyz(200, time=(first + ramp).astype(np.float32)), stamp))
        np.testing.assert_allclose(offset, first + ramp, atol=1e-6)


def test_times_that_mean_nothing_are_none() -> None:
    """Unsigned times from before the stamp: as zeros, nearly all of them would count as known."""
    early = np.uint32(np.arange(-20_000_000, 80_000_000, 1_000_000) % 2**32)
    msg = cloud(xyz(100, t=early))
    assert messages.decode_points(msg)[1] is None
    assert messages.why_untimed(msg) == "t is no possible time of most points"


@pytest.mark.parametrize("wrong", [0, 7e9, 4294967295])
@pytest.mark.parametrize(
    ("began", "unit"), [(0, 1e-6), (0, 1e-9), (0, 1), (STAMP * 1e-9, 1), (60e9, 1e-9), (5.0, 1)]
)  # fmt: skip
def test_one_time_that_is_far_off_spoils_no_other(began: float, unit: float, wrong: float) -> None:
    """For example of a damaged packet. Previously, it changed the unit of the others, or their start. The tolerance is
    that of an epoch in float64."""
    ramp = np.linspace(0, 0.1, 1000)
    time = began + ramp / unit
    spoiled = time.copy()
    spoiled[500] = wrong
    _, want = messages.decode_points(cloud(xyz(1000, timestamp=time)))
    _, got = messages.decode_points(cloud(xyz(1000, timestamp=spoiled)))
    assert want is not None
    np.testing.assert_allclose(want, ramp, atol=1e-6)
    np.testing.assert_allclose(np.delete(got, 500), np.delete(want, 500), atol=1e-6)
    assert abs(got[500]) <= 2


def test_two_times_years_apart_are_no_sweep() -> None:
    """Nothing shows which of the two is right: neither point is moved by more than the longest sweep."""
    _, offset = messages.decode_points(cloud(xyz(2, timestamp=np.array([5.0, STAMP * 1e-9 + 1e8]))))
    assert offset is None or np.abs(offset).max() <= 2.0


def test_times_that_no_sweep_can_have_are_left_out() -> None:
    """They would move points anywhere; the other points keep their times."""
    _, offset = messages.decode_points(cloud(xyz(5, t=np.array([0.0, 0.05, 0.1, 1e300, np.nan]))), time_unit="s")
    np.testing.assert_allclose(offset[:3], [0, 0.05, 0.1])
    assert np.isfinite(offset).all()
    assert np.abs(offset).max() <= 2.0
