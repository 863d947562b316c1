# SPDX-License-Identifier: Apache-2.0
"""Which result is taken if network and points agree, if one of them has none, and if they contradict each other.

The points are real scans of the synthetic city. The network's result is chosen, so that it can be deliberately wrong.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame, Image, Points
from dpm2_core.geometry import se3
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings, Scan
from dpm2_core.slam.registration.fused import FusedScanRegistration
from dpm2_core.slam.registration.icp import GeometricRegistration, GeometricScanRegistration, GeometricSettings
from dpm2_core.slam.registration.local_map import LocalMap, LocalMapSettings
from dpm2_core.slam.registration.protocol import Prediction

from ....helpers.drives import Drive
from ....helpers.scenes import make_image

SIGMA = np.repeat([0.001, 0.04], 3)  # standard deviations that the network reports, rad and m


class Oracle:
    """A network with a given result."""

    uses_images = False
    T: Array = np.eye(4)
    ok = True
    size = 1
    scale = 1.0
    asked = 0

    def __len__(self) -> int:
        return self.size

    def describe(self, points: Points, images: tuple[Image, ...]) -> None:
        return None

    def keep(self, scan: Scan, T_odom_lidar: Array) -> None:
        self.size += 1

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        self.asked += 1
        reason = "" if self.ok else "no idea"
        return Registration(self.T, np.diag((self.scale * SIGMA) ** 2), 0.9, 0.1, "neural", self.ok, reason)


class Case:
    """The sixth scan of a drive, to be registered to the previous five."""

    def __init__(self, drive: Drive, always: bool = True, images: bool = False) -> None:
        frames, truth = drive
        if images:
            frames = [replace(frame, images=(make_image(np.random.default_rng(0)),)) for frame in frames]
        self.oracle = Oracle()
        self.oracle.uses_images = images
        geometric = GeometricScanRegistration(
            Preprocessor(PreprocessSettings()),
            GeometricRegistration(GeometricSettings()),
            LocalMap(LocalMapSettings(), PreprocessSettings().map_voxel),
        )
        self.registration = FusedScanRegistration(self.oracle, geometric, always)  # type: ignore[arg-type]
        for frame, T in zip(frames[:5], truth[:5], strict=True):
            self.registration.update(self.registration.prepare(frame, np.zeros(6)), T)
        self.scan = self.registration.prepare(frames[5], np.zeros(6))
        self.truth = truth[5]
        self.prediction = Prediction([self.truth @ se3.exp([0, 0, 0.005, 0.05, 0, 0])], information=100 * np.eye(6))

    def register(self, off: list[float], **oracle: object) -> tuple[Registration, float]:
        """Result and its error, m, if the network is off by the tangent vector `off`."""
        self.oracle.T = self.truth @ se3.exp(off)
        for name, value in oracle.items():
            setattr(self.oracle, name, value)
        result = self.registration.register(self.scan, self.prediction)
        return result, float(np.linalg.norm(result.T_target_source[:3, 3] - self.truth[:3, 3]))


def between_walls() -> Drive:
    """Six scans, 0.2 m apart, of a floor and walls that are smooth except for a niche 1 m deep and 1.5 m long."""
    noise = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (6, 1, 1))
    truth[:, 0, 3] = 0.2 * np.arange(6)
    frames = []
    for i, T in enumerate(truth):
        x, side, height = noise.uniform(-20, 20, 12000), noise.choice([-3.0, 3.0], 12000), noise.uniform(-1, 2, 12000)
        side[(np.abs(x - 5) < 0.75) & (side > 0)] += 1
        ends = np.column_stack([noise.choice([4.25, 5.75], 600), noise.uniform(3, 4, 600), noise.uniform(-1, 2, 600)])
        floor = np.column_stack([noise.uniform(-20, 20, 4000), noise.uniform(-3, 3, 4000), np.full(4000, -1.0)])
        points = np.concatenate([np.column_stack([x, side, height]), ends, floor]) - T[:3, 3]
        points += noise.normal(0, 0.01, points.shape)
        frames.append(Frame(i * 10**8, np.pad(points, ((0, 0), (0, 1))).astype(np.float32), index=i))
    return frames, truth


@pytest.fixture
def case(suburb_drive: Drive) -> Case:
    return Case(suburb_drive)


def test_points_refine_the_network_where_both_agree(case: Case) -> None:
    result, error = case.register([0, 0, 0.001, 0.05, -0.03, 0])
    assert (result.ok, result.method, result.reason) == (True, "refined", "")
    assert error < 0.02  # the network was off by 6 cm


def test_a_network_that_knows_less_moves_nothing(case: Case) -> None:
    result, _ = case.register([0, 0, 0.005, 0.3, -0.2, 0], scale=3.0)
    assert (result.ok, result.method) == (True, "refined")
    alone, _ = case.register([0, 0, 0, 0, 0, 0], size=0)
    np.testing.assert_allclose(result.T_target_source, alone.T_target_source, atol=1e-9)


def test_a_network_that_claims_more_than_few_points_moves_nothing(suburb_drive: Drive) -> None:
    """It reports 0.04 m and the points 0.06 m. As at the walls of a building, it is off by more than either."""
    case, frame = Case(suburb_drive), suburb_drive[0][5]
    case.scan = case.registration.prepare(replace(frame, points=frame.points[::100]), np.zeros(6))
    result, _ = case.register([0, 0, 0, 0.2, 0, 0])
    assert (result.ok, result.method, result.reason) == (True, "refined", "")
    alone, error = case.register([0, 0, 0, 0, 0, 0], size=0)
    assert error < 0.05 < alone.worst_sigma
    np.testing.assert_allclose(result.T_target_source, alone.T_target_source, atol=1e-9)
    np.testing.assert_allclose(result.covariance, alone.covariance, atol=1e-12)


@pytest.mark.parametrize("silent", [{"ok": False}, {"size": 0}])
def test_points_alone_where_the_network_is_silent(case: Case, silent: dict[str, object]) -> None:
    result, error = case.register([0, 0, 0, 5, 0, 0], **silent)
    assert (result.ok, result.method) == (True, "geometric")
    assert result.reason.startswith("neural: ")
    assert error < 0.02


def test_network_alone_where_the_points_fit_nothing(case: Case) -> None:
    elsewhere = np.random.default_rng(3).uniform(-40, 40, (8000, 4)).astype(np.float32)
    case.scan = case.registration.prepare(Frame(0, elsewhere), np.zeros(6))
    result, error = case.register([0, 0, 0, 0.03, 0, 0])
    assert (result.ok, result.method) == (True, "neural")
    assert result.reason.startswith("not refined: ")
    assert error == pytest.approx(0.03)
    assert result.worst_sigma > 0.2  # whatever the network reports


def test_a_network_that_no_points_confirm_is_drawn_to_where_the_motion_leads_elsewhere(case: Case) -> None:
    """Its pose is accurate to 0.3 m at best, that of wheels or a steady motion to 0.1 m. If the motion is not known,
    nothing contradicts the network."""
    elsewhere = np.random.default_rng(3).uniform(-40, 40, (8000, 4)).astype(np.float32)
    case.scan = case.registration.prepare(Frame(0, elsewhere), np.zeros(6))
    result, error = case.register([0, 0, 0, 0.5, 0, 0])
    assert (result.ok, result.method) == (True, "neural")
    assert 0.05 < error < 0.1  # the motion is 0.05 m off
    assert result.worst_sigma > 0.2
    case.prediction = replace(case.prediction, information=0.5 * np.eye(6))
    result, error = case.register([0, 0, 0, 0.5, 0, 0])
    assert error == pytest.approx(0.5)


def test_a_network_that_is_wrong_and_sure_of_it_is_outvoted(case: Case) -> None:
    result, error = case.register([0, 0, 0, 0.6, 0.2, 0])
    assert (result.ok, result.method) == (True, "geometric")
    assert "m, 0.0 deg apart" in result.reason
    assert error < 0.02
    assert result.worst_sigma < 0.05  # nearly all points fit


def test_the_network_leads_the_points_where_the_motion_does_not(case: Case) -> None:
    case.prediction = replace(case.prediction, starts=[case.truth @ se3.exp([0, 0, 1.5, 30, 0, 0])])
    result, error = case.register([0, 0, 0.001, 0.05, -0.03, 0])
    assert (result.ok, result.method, result.reason) == (True, "refined", "")
    assert error < 0.02  # the network was off by 6 cm


def test_a_contradiction_that_nothing_settles_is_answered_with_uncertainty(case: Case) -> None:
    case.prediction = replace(case.prediction, starts=[case.truth @ se3.exp([0, 0, 1.5, 30, 0, 0])])
    result, _ = case.register([0, 0, 0, 0.6, 0.2, 0])
    assert (result.ok, result.method) == (True, "neural")
    assert "apart" in result.reason
    assert result.worst_sigma > 0.5  # it covers its error of 0.63 m; beyond 0.08 m the state is `degraded`


def test_while_no_motion_is_known_the_network_gives_one_more_start(case: Case) -> None:
    """From a start 12 m off, the points converge elsewhere; from a network 0.6 m off with a small covariance, they do
    not."""
    case.prediction = Prediction([case.truth @ se3.exp([0, 0, 0, 12, 0, 0])], widen=2.0)
    _, lost = case.register([0, 0, 0, 0, 0, 0], size=0)
    assert lost > 5
    result, error = case.register([0, 0, 0, 0.6, 0.2, 0], size=1)
    assert (result.ok, result.method) == (True, "geometric")
    assert error < 0.02


@pytest.mark.parametrize(("off", "method"), [([0.05, 0.02], "refined"), ([0.6, 0.2], "geometric")])
@pytest.mark.parametrize("known", [0.01, 4.0])
def test_where_two_disagree_the_likelier_is_taken(case: Case, off: list[float], method: str, known: float) -> None:
    """From a start 9 m off, points fit somewhere, but not as well as from the network's pose: even if the network is
    0.6 m off with a small covariance, and whether the motion is assumed to be known to 10 m or to 0.5 m."""
    start = case.truth @ se3.exp([0, 0, 0, 9, 0, 0])
    case.prediction = Prediction([start], widen=2.0, information=known * np.eye(6))
    somewhere, error = case.register([0, 0, 0, 0, 0, 0], size=0)
    assert somewhere.ok
    assert error > 5
    result, error = case.register([0, 0, 0, *off, 0], size=1)
    assert (result.ok, result.method) == (True, method)
    assert error < 0.02


def test_what_few_points_show_is_found_from_the_network() -> None:
    """Two walls with a niche. From a start 4 m off, points leave one translation open, and do not contradict the
    network."""
    case = Case(between_walls())
    information = np.diag(np.repeat([1.0, 2.0], 3) ** -2.0)
    case.prediction = Prediction([case.truth @ se3.exp([0, 0, 0, -4, 0, 0])], information=information)
    alone, lost = case.register([0, 0, 0, 0, 0, 0], size=0)
    assert lost > 2
    assert alone.worst_sigma > 0.5
    result, error = case.register([0, 0, 0, 0.05, 0.02, 0], size=1)
    assert result.ok
    assert error < 0.1


def beside_a_wall() -> Drive:
    """Six scans of level ground in rings (24 beams) and of a smooth wall: five 0.05 m apart, one 2 m further on."""
    noise, truth = np.random.default_rng(0), np.tile(np.eye(4), (6, 1, 1))
    truth[:, 0, 3] = [0, 0.05, 0.1, 0.15, 0.2, 2.2]
    frames = []
    for n in range(6):
        angle, beam = np.meshgrid(np.linspace(-np.pi, np.pi, 720, endpoint=False), np.arange(3.0, 27.0))
        down = np.radians(beam + noise.normal(0, 0.3, beam.shape))  # the ground is not quite level
        to_wall = np.divide(8.0, np.sin(angle), out=np.full_like(angle, np.inf), where=angle > 0)
        r = np.minimum(1.5 / np.tan(down), to_wall)
        xyz = np.stack([r * np.cos(angle), r * np.sin(angle), -r * np.tan(down)], -1)[r < 40]
        xyz += noise.normal(0, 0.01, xyz.shape)
        frames.append(Frame(n * 10**8, np.pad(xyz, ((0, 0), (0, 1))).astype(np.float32), index=n))
    return frames, truth


def test_along_what_stays_open_the_network_lures_nobody_away() -> None:
    """The network reports a standstill with a small covariance, where the map has the rings that a scan shows. The scan
    fits nearly as well where the motion leads, although the motion is known only to 5 m."""
    case = Case(beside_a_wall())
    case.prediction = Prediction([case.truth], information=np.diag(np.repeat([0.1, 5.0], 3) ** -2.0))
    result, error = case.register([0, 0, 0, -2, 0, 0], size=5)
    assert result.ok
    assert result.worst_sigma > 0.9
    assert error < 0.3


def test_the_network_is_asked_only_where_the_points_do_not_know(suburb_drive: Drive, tunnel_drive: Drive) -> None:
    """Points with a small covariance are the result to the bit, however little is known of the motion. Points that fit
    only from the network's pose are the result alone. In a tunnel the network is used."""
    case, always = Case(suburb_drive, always=False), Case(suburb_drive)
    result, error = case.register([0, 0, 0, 5, 0, 0])
    assert (result.ok, result.method, result.reason, case.oracle.asked) == (True, "geometric", "", 0)
    assert error < 0.02
    alone, _ = always.register([0, 0, 0, 0, 0, 0], size=0)
    np.testing.assert_array_equal(result.T_target_source, alone.T_target_source)
    for information in (np.eye(6) / 4, None):  # a motion known to 2 m, or not at all
        case.prediction = replace(case.prediction, information=information)
        result, error = case.register([0, 0, 0, 5, 0, 0])
        assert (result.method, result.reason, case.oracle.asked) == ("geometric", "", 0)
        assert error < 0.02
    case.prediction = Prediction([case.truth @ se3.exp([0, 0, 0, 12, 0, 0])], widen=2.0)
    led, error = case.register([0, 0, 0.001, 0.05, -0.03, 0])
    assert (led.ok, led.method, case.oracle.asked) == (True, "geometric", 1)
    assert error < 0.02
    tunnel = Case(tunnel_drive, always=False)
    assert tunnel.register([0, 0, 0, 0.02, 0.03, 0])[0].method == "refined"
    assert tunnel.oracle.asked == 1


def test_more_of_the_points_must_fit_where_the_motion_is_not_known(suburb_drive: Drive) -> None:
    """In a scan with 400 noise points in the air, 0.72 of all fit. This is accepted only if the motion is known."""
    frames, truth = suburb_drive
    elsewhere = np.random.default_rng(3).uniform([-40, -40, 3, 0], [40, 40, 12, 1], (400, 4)).astype(np.float32)
    noisy = replace(frames[5], points=np.concatenate([frames[5].points, elsewhere]))
    case = Case(([*frames[:5], noisy], truth), always=False)
    alone, error = case.register([0, 0, 0, 0, 0, 0], size=0)
    assert 0.7 <= alone.confidence < 0.75
    assert error < 0.02
    case.register([0, 0, 0, 0.05, 0, 0], size=1)
    assert case.oracle.asked == 0
    case.prediction = replace(case.prediction, information=np.eye(6) / 4)
    case.register([0, 0, 0, 0.05, 0, 0])
    assert case.oracle.asked == 1


def test_points_that_fit_just_where_the_motion_leads_are_enough(suburb_drive: Drive) -> None:
    """Half of them fit, as with few beams in a young map. Along a corridor of equal doors, the network was 0.35 m off
    at a stated 5 mm, and the points fitted better there: the drive was 5.2 m off as `tracking`. Without the network it
    was 0.002 m."""
    frames, truth = suburb_drive
    elsewhere = np.random.default_rng(3).uniform([-40, -40, 3, 0], [40, 40, 12, 1], (900, 4)).astype(np.float32)
    noisy = replace(frames[5], points=np.concatenate([frames[5].points, elsewhere]))
    case = Case(([*frames[:5], noisy], truth), always=False)
    result, error = case.register([0, 0, 0, -0.35, 0, 0])
    assert 0.5 <= result.confidence < 0.7
    assert (result.method, case.oracle.asked) == ("geometric", 0)
    assert error < 0.02
    contradicted, error = Case(([*frames[:5], noisy], truth)).register([0, 0, 0, -0.35, 0, 0])
    assert contradicted.reason.startswith("neural and geometric 0.35 m")
    assert error < 0.02
    assert contradicted.worst_sigma > 0.3  # half of the points fit, and the network contradicts them
    hardly, error = Case(([*frames[:5], noisy], truth)).register([0, 0, 0, -0.2, 0, 0])  # 3.7 standard deviations
    assert hardly.reason.startswith("neural and geometric 0.20 m")
    assert error < 0.02
    case.prediction = replace(case.prediction, starts=[case.truth @ se3.exp([0, 0, 0, 0.15, 0, 0])])  # 1.5 deviations
    case.register([0, 0, 0, 0.05, 0, 0])
    assert case.oracle.asked == 1


def test_along_a_tunnel_the_network_by_its_images_counts_little_where_the_motion_is_known(tunnel_drive: Drive) -> None:
    """The network is a meter off along the tunnel: its matches have a common error. The result stays with the motion.
    The image is used, as always if a standard deviation is above 0.08 m. Across the tunnel, where the points are
    certain, nothing moves."""
    case = Case(tunnel_drive, images=True)
    result, _ = case.register([0, 0, 0, 1.0, 0.03, 0])
    assert (result.ok, result.method) == (True, "refined")
    off = se3.way(case.truth, result.T_target_source)
    assert abs(off[3]) < 0.3
    assert abs(off[4]) < 0.02
    assert result.worst_sigma > 0.5


def test_along_a_tunnel_the_network_by_its_images_leads_where_the_motion_is_not_known(tunnel_drive: Drive) -> None:
    """The points fit everywhere, and best without any motion: 8 m behind."""
    case = Case(tunnel_drive, images=True)
    case.prediction = Prediction([case.truth @ se3.exp([0, 0, 0, -8, 0, 0])], widen=2.0)
    result, error = case.register([0, 0, 0, 0.2, 0.03, 0])
    assert result.ok
    assert error < 0.5
    assert result.worst_sigma > 0.08


@pytest.mark.parametrize("camera", [False, True])
def test_along_a_tunnel_a_network_without_images_is_not_believed(tunnel_drive: Drive, camera: bool) -> None:
    """The network reports a small covariance where the points leave a direction open, and is a meter off. The
    uncertainty stays that of the points, also for a network with a camera if a scan has no image."""
    case = Case(tunnel_drive)
    case.registration.uses_images = camera
    result, _ = case.register([0, 0, 0, 1.0, 0, 0])
    assert result.ok
    assert result.worst_sigma > 0.5
    off = se3.way(case.truth, result.T_target_source)
    assert abs(off[3]) < 0.3  # the error of the prediction and of the points
