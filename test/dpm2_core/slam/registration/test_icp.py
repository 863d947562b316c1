# SPDX-License-Identifier: Apache-2.0
"""Registration of points to a map: what is accepted if only part of a scan has correspondences, and which of several
starts is chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.odometry.settings import OdometrySettings
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings, Scan
from dpm2_core.slam.registration.icp import GeometricRegistration, GeometricScanRegistration, GeometricSettings
from dpm2_core.slam.registration.local_map import LocalMap, LocalMapSettings
from dpm2_core.slam.registration.protocol import Prediction, agree

from ....helpers.drives import Drive, make_drive

PRIOR = np.eye(6) / 0.1**2  # information of a velocity known to 1 m/s, 10 Hz
Case = tuple[GeometricScanRegistration, Scan, Array]


def make_registration() -> GeometricScanRegistration:
    """Registration with the default settings and an empty map."""
    return GeometricScanRegistration(
        Preprocessor(PreprocessSettings()),
        GeometricRegistration(GeometricSettings()),
        LocalMap(LocalMapSettings(), PreprocessSettings().map_voxel),
    )


def make_case(drive: Drive, seen: float) -> Case:
    """A map of one scan, of which only the fraction `seen` of the azimuth is visible; the fourth scan after it, and its
    pose."""
    (frames, truth), registration = drive, make_registration()
    first, later = (registration.prepare(frames[i], np.zeros(6)) for i in (0, 4))
    azimuth = np.arctan2(first.cloud[:, 1], first.cloud[:, 0])
    visible = np.cos(azimuth * 2) > np.cos(np.pi * seen)  # two sectors, ahead and behind
    registration.update(Scan(first.points, first.cloud[visible], first.source), np.eye(4))
    return registration, later, truth[4]


@pytest.fixture
def occluded(suburb_drive: Drive) -> Case:
    return make_case(suburb_drive, 0.4)


def error(T: Array, truth: Array) -> float:
    return float(np.linalg.norm((se3.inverse(truth) @ T)[:3, 3]))


def test_what_the_motion_led_to_expect_needs_fewer_counterparts(occluded: Case) -> None:
    registration, scan, truth = occluded
    start = truth @ se3.exp([0, 0, 0.005, 0.1, 0.03, 0])
    result = registration.register(scan, Prediction([start], information=PRIOR))
    assert 0.3 < result.confidence < 0.5, "else the case is none"
    assert result.ok
    assert error(result.T_target_source, truth) < 0.05  # a young map of 0.5 m cells: centimeters
    guessed = registration.register(scan, Prediction([start]))
    assert not guessed.ok
    assert guessed.reason.endswith("points fit the map")


@pytest.mark.parametrize("off", [[0, 0, 0, 2, 0, 0], [0, 0, 0, -2, 0, 0], [0, 0, 0, 0, 3, 0], [0, 0, 0.15, 2, 2, 0]])
def test_a_wrong_prediction_in_a_map_of_one_scan_is_never_confirmed_without_uncertainty(
    occluded: Case, off: list[float]
) -> None:
    """Along the road, ground alone may fit anywhere. Then the covariance shows it, and the state is `degraded`."""
    registration, scan, truth = occluded
    result = registration.register(scan, Prediction([truth @ se3.exp(off)], information=PRIOR))
    wrong = error(result.T_target_source, truth)
    assert not result.ok or result.worst_sigma > max(OdometrySettings().degraded_sigma, wrong / 3)


def test_a_scan_of_elsewhere_is_rejected_where_it_was_expected(occluded: Case) -> None:
    """18 % of the points of a highway fit; 30 % are required."""
    registration, _, truth = occluded
    elsewhere = Preprocessor(PreprocessSettings()).prepare(make_drive("highway", 1)[0][0], np.zeros(6))
    assert not registration.register(elsewhere, Prediction([truth], information=PRIOR)).ok


def test_the_most_likely_start_wins_whatever_its_place(suburb_drive: Drive) -> None:
    registration, scan, truth = make_case(suburb_drive, 1.0)
    off = truth @ se3.exp([0, 0, 0, 6, 1, 0])  # too far away to converge
    for starts in ([off, truth], [truth, off]):
        result = registration.register(scan, Prediction(starts))
        assert result.ok
        assert error(result.T_target_source, truth) < 0.05


@pytest.mark.parametrize("off", [[0, 0, 0.14, 1, 0.5, 0], [0, 0, -0.14, 1, 0, 0], [0, 0, 0.16, 2, 1, 0]])
def test_the_heading_is_looked_for_where_a_curve_may_have_ended(suburb_drive: Drive, off: list[float]) -> None:
    """8 or 9 degrees off. The search always runs if the motion is not known; if it is known, it runs where few points
    fit."""
    registration, scan, truth = make_case(suburb_drive, 1.0)
    start = truth @ se3.exp(off)
    for information in (np.eye(6), np.eye(6) / 2**2, None):
        result = registration.register(scan, Prediction([start], information=information))
        assert result.ok
        assert error(result.T_target_source, truth) < 0.05


def test_on_a_plain_the_heading_stays_that_of_the_motion() -> None:
    """Rings on the ground fit at any heading. By chance, another heading may seem to fit a little better."""
    registration, rng = make_registration(), np.random.default_rng(0)
    height, azimuth = 1.7, np.linspace(-np.pi, np.pi, 1024, endpoint=False)
    radius = np.repeat(height / np.tan(np.radians(np.linspace(1.5, 25, 40))), len(azimuth))
    ring = np.column_stack([radius * np.cos(np.tile(azimuth, 40)), radius * np.sin(np.tile(azimuth, 40))])
    plain = np.column_stack([ring, np.full(len(ring), -height), np.zeros(len(ring))])
    noise = np.array([0.02, 0.02, 0.02, 0])

    def scan() -> Scan:
        points = (plain + noise * rng.standard_normal(plain.shape)).astype(np.float32)
        return registration.prepare(Frame(0, points), np.zeros(6))

    for x in (0.0, 1.0, 2.0):
        registration.update(scan(), se3.make(np.eye(3), [x, 0, 0]))
    turns_little = np.diag(np.repeat([0.01, 2.0], 3) ** -2.0)  # so that the scan keeps its initial heading
    for x in (6.0, 7.1, 8.3, 9.2, 10.4):
        start = se3.make(np.eye(3), [x, 0, 0])
        result = registration.register(scan(), Prediction([start], information=turns_little))
        assert se3.apart(start, result.T_target_source)[1] < 2


def test_where_sight_returns_what_was_too_far_to_be_seen_does_not_count(suburb_drive: Drive) -> None:
    """After fog with a visibility of 10 m, 10 to 15 % of the points fitted. Previously, the state was lost, with a
    break after ten frames."""
    frames, truth = suburb_drive
    registration = make_registration()
    for frame, T in zip(frames[:8], truth[:8], strict=True):
        near = np.linalg.norm(frame.points[:, :3], axis=1) < 10
        dull = replace(frame, points=frame.points[near], time_offset=None)
        registration.update(registration.prepare(dull, np.zeros(6)), T)
    scan = registration.prepare(frames[8], np.zeros(6))
    assert (np.linalg.norm(scan.source, axis=1) > 11).mean() > 0.6
    result = registration.register(scan, Prediction([truth[8]], information=PRIOR))
    assert result.ok
    assert result.confidence > 0.7
    assert error(result.T_target_source, truth[8]) < 0.1  # along the street, the motion determines it


@pytest.mark.parametrize("information", [np.eye(6), None])
def test_a_scan_without_points_fails(suburb_drive: Drive, information: Array | None) -> None:
    registration, scan, truth = make_case(suburb_drive, 1.0)
    nothing = replace(scan, source=np.zeros((0, 3)))
    result = registration.register(nothing, Prediction([truth], information=information))
    assert (result.ok, result.reason[:17]) == (False, "0 points against ")


def test_likelihood_is_greatest_at_the_truth(suburb_drive: Drive) -> None:
    frames, truth = suburb_drive
    scan = Preprocessor(PreprocessSettings()).prepare(frames[4], np.zeros(6))
    local_map = LocalMap(LocalMapSettings(), PreprocessSettings().map_voxel)
    local_map.insert(Preprocessor(PreprocessSettings()).prepare(frames[0], np.zeros(6)).cloud, np.eye(4))
    method = GeometricRegistration(GeometricSettings())
    fit = [method.likelihood(scan.source, local_map, truth[4] @ se3.exp([0, 0, 0, x, 0, 0])) for x in (0, 0.3, 1, 3)]
    assert fit == sorted(fit, reverse=True)
    assert method.likelihood(scan.source + 1e3, local_map, truth[4]) == 0  # no correspondence at all


def test_along_a_tunnel_answers_agree_and_the_least_motion_is_kept(tunnel_drive: Drive) -> None:
    """The distance traveled is not observable there: starts that end meters apart do not contradict each other."""
    registration, scan, _ = make_case(tunnel_drive, 1.0)
    starts = [se3.exp([0, 0, 0, x, 0, 0]) for x in (1.0, 2.0)]
    alone = [registration.register(scan, Prediction([T])) for T in starts]
    assert np.linalg.norm(alone[0].T_target_source[:3, 3] - alone[1].T_target_source[:3, 3]) > 0.3
    assert agree(*alone)
    kept = registration.register(scan, Prediction(starts))
    np.testing.assert_allclose(kept.T_target_source, alone[0].T_target_source, atol=1e-9)


def mapped(drive: Drive) -> GeometricScanRegistration:
    """Registration with a map of five scans of a drive."""
    made = make_registration()
    for frame, T in zip(*(part[:5] for part in drive), strict=True):
        made.update(made.prepare(frame, np.zeros(6)), T)
    return made


def searched(drive: Drive, starts: list[Array]) -> tuple[bool, str, float]:
    """Search for the pose of the sixth scan: whether it succeeds, why not, and the error, m."""
    registration = mapped(drive)
    scan: Scan = registration.prepare(drive[0][5], np.zeros(6))
    result = registration.register(scan, Prediction(starts, unique=True))
    return result.ok, result.reason, float(np.linalg.norm((result.T_target_source - drive[1][5])[:3, 3]))


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_the_place_is_found_among_many(suburb_drive: Drive, turn: float) -> None:
    """A start that is off by half a meter and four degrees is near enough."""
    grid = [[0, 0, turn + yaw, x, y, 0] for yaw in (-0.3, -0.15, 0, 0.15) for x in range(-8, 9) for y in (-1, 0, 1)]
    off = np.array([0, 0, 0.07, 0.25, 0.25, 0])
    ok, reason, error = searched(suburb_drive, [suburb_drive[1][5] @ se3.exp(xi) for xi in np.array(grid) + off])
    assert (ok, reason) == (True, "")
    assert error < 0.03


def test_two_places_that_look_alike_are_none(tunnel_drive: Drive) -> None:
    """Along a tunnel every start fits."""
    starts = [tunnel_drive[1][5] @ se3.exp([0, 0, 0, x, 0, 0]) for x in np.arange(-6, 6.5, 0.5)]
    ok, reason, _ = searched(tunnel_drive, starts)
    assert not ok
    assert "m away fits as well" in reason


def test_where_the_scan_was_not_taken_it_is_not_found(suburb_drive: Drive) -> None:
    ok, reason, _ = searched(suburb_drive, [se3.exp([0, 0, 0, x, 60, 0]) for x in range(8)])
    assert not ok
    assert reason
