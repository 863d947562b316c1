# SPDX-License-Identifier: Apache-2.0
"""Loops in a street that is driven again, in the same direction, in reverse and across, with any drift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Edge, Keyframe, Registration, isotropic
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ByScale
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.network.decoder import Correlated, Decoder
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pose_solver import Solved
from dpm2_core.network.pretrained import load_network
from dpm2_core.network.tokens import Tokens
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import LidarConfig
from dpm2_core.sim.world import World, build_world
from dpm2_core.slam.build import make_loops
from dpm2_core.slam.loops.closure import LoopCloser, LoopSettings
from dpm2_core.slam.loops.place_recognition import AGREEING, PlaceRecognition, merged
from dpm2_core.slam.loops.verification import VerificationSettings, Verifier
from dpm2_core.slam.preprocess import PreprocessSettings
from dpm2_core.slam.registration.icp import GeometricSettings
from dpm2_core.slam.settings import SlamSettings

from ....helpers.drives import street
from ....helpers.maps import FIRM
from ....helpers.rooms import BOTH_ENDS, CABINET, HALL, ROUND, standing
from ....helpers.rooms import scan as room_scan

OFF = isotropic(0.01, 0.7)
STREET = np.arange(40.0, 105.0, 5.0)
ONE_PART = np.zeros(100, np.intp)  # all keyframes are in one part of the graph


def suburb() -> World:
    return street("suburb", 8)


@cache
def network() -> DeepPointMap2:
    return load_network("small", 1)


@cache
def described(s: float, lateral: float, heading: float) -> Descriptors | None:
    return closer().described(Keyframe(0, 0, 0, np.eye(4), scan(s, lateral, heading))).descriptors


@cache
def scan(s: float, lateral: float, heading: float) -> Points:
    """Points seen from there, the same each time."""
    rng = np.random.default_rng([int(10 * s), int(100 + lateral), int(10 * heading)])
    return Lidar(LidarConfig()).scan(suburb(), where(s, lateral, heading), 0.1 * s, rng).points


def where(s: float, lateral: float = 0.0, heading: float = 0.0) -> Array:
    return suburb().pose_at(s, lateral, heading)


def closer(with_network: bool = True, **settings: object) -> LoopCloser:
    way = (
        LoopSettings.model_validate(settings),
        Verifier(VerificationSettings(), GeometricSettings(), PreprocessSettings()),
    )
    return LoopCloser(ByScale(way, way), network() if with_network else None)


def drive(places: Sequence[tuple[float, float, float]], jump: Array, **settings: object) -> tuple[list[Edge], Array]:
    """Loops tried along the street and then at `places`, before which the odometry has an error of `jump`."""
    at = [(s, 0.0, 0.0) for s in STREET] + list(places)
    truth = np.array([where(*place) for place in at])
    odometry = truth.copy()
    odometry[len(STREET) :] = jump @ odometry[len(STREET) :]
    loops, keyframes, clouds = [], [], []
    search = closer(**settings)
    for i, place in enumerate(at):
        edge = Registration(np.eye(4), OFF if i == len(STREET) else FIRM, 1.0, 0.1, "test") if i else None
        clouds.append(scan(*place))
        keyframes.append(Keyframe(i, i, i, odometry[i], clouds[-1], edge, "", described(*place)))
        loops += search.close(keyframes, clouds, odometry[: i + 1], ONE_PART[: i + 1])
    return loops, truth


def errors(loops: Sequence[Edge], truth: Array) -> list[float]:
    """Translation errors of the loops, m."""
    true = [se3.inverse(truth[loop.from_node]) @ truth[loop.to_node] for loop in loops]
    off = [se3.inverse(T) @ loop.T_from_to for T, loop in zip(true, loops, strict=True)]
    return [float(np.linalg.norm(T[:3, 3])) for T in off]


def test_what_is_merged_around_a_keyframe_has_the_scale_of_that_one(noise: np.random.Generator) -> None:
    """Where a drive leaves a room, the scales differ. Previously, the scale was that of the first keyframe: the
    descriptors were those of the room, without the keyframe itself."""
    scales = (5.0, 5.0, 1.0, 1.0)
    sets = [replace(Descriptors.of(noise.normal(0, 9, (9 + i, 3)), noise.normal(size=(9 + i, 128))), scale=scale)
            for i, scale in enumerate(scales)]  # fmt: skip
    keyframes = [Keyframe(i, i, i, np.eye(4), np.zeros((0, 4), np.float32), None, "", d) for i, d in enumerate(sets)]
    found = merged(keyframes, np.tile(np.eye(4), (4, 1, 1)), range(4), 2)
    assert (found.scale, len(found)) == (1.0, 11 + 12)


@pytest.mark.slow
@pytest.mark.weights
@pytest.mark.parametrize("heading", [0.0, np.pi, np.pi / 2], ids=["same", "reverse", "across"])
def test_a_revisit_is_found_whatever_the_drift_and_heading(heading: float) -> None:
    """The odometry is 2 m off, which its covariance allows."""
    places = [(s, 2.5, heading) for s in (62.0, 67.0, 72.0)]
    jump = se3.exp(np.array([0, 0, np.radians(0.6), 1.2, 0.6, 0]))
    loops, truth = drive(places, jump, gap=30.0, consistency={"drift": 0.05})
    accepted = [loop for loop in loops if loop.registration.ok]
    assert {loop.to_node for loop in accepted} == {len(STREET), len(STREET) + 1, len(STREET) + 2}
    assert max(errors(accepted, truth)) < 0.1
    waited = [loop for loop in loops if "waits" in loop.registration.reason]
    assert len(waited) <= 1  # the first one, for the second


@pytest.mark.slow
@pytest.mark.weights
def test_places_that_agree_on_no_motion_are_not_correlated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Correlation takes seven times as long, and nearly every candidate is another place."""
    places = PlaceRecognition(load_network("small", 1))
    here, near, far = (described(*place) for place in ((40.0, 0.0, 0.0), (44.0, 2.0, np.pi), (104.0, 0.0, 0.0)))
    assert here is not None
    assert near is not None
    assert far is not None
    found, other = places.register(here, [near, far], AGREEING)
    assert found.ok
    assert found.confidence > 0.3
    assert not other.ok
    assert "another place" in other.reason
    monkeypatch.setattr(DeepPointMap2, "register", lambda *_: pytest.fail("the network was asked"))
    assert not places.register(here, [far], AGREEING)[0].ok


@pytest.mark.slow
@pytest.mark.weights
def test_a_place_never_seen_closes_no_loop_and_each_candidate_has_its_reason() -> None:
    world = street("city", 5)
    lidar, rng, search = Lidar(LidarConfig()), np.random.default_rng(0), closer(gap=30.0)
    keyframes, clouds, loops = [], [], []
    poses = np.array([where(s) for s in STREET] + [where(s) for s in (60.0, 65.0)])
    for i, T in enumerate(poses):
        elsewhere = i >= len(STREET)
        cloud = lidar.scan(world, world.pose_at(60.0 + i), 0.0, rng).points if elsewhere else scan(STREET[i], 0.0, 0.0)
        edge = Registration(np.eye(4), FIRM, 1.0, 0.1, "test") if i else None
        clouds.append(cloud)
        known = None if elsewhere else described(STREET[i], 0.0, 0.0)
        keyframes.append(search.described(Keyframe(i, i, i, T, cloud, edge, "", known)))
        loops = search.close(keyframes, clouds, poses[: i + 1], ONE_PART[: i + 1]) if elsewhere else loops
    assert loops
    assert all(not loop.registration.ok and loop.registration.reason for loop in loops)


@pytest.mark.slow
@pytest.mark.weights
@pytest.mark.parametrize(("away", "closed"), [(500.0, False), (0.0, True)], ids=["two places", "one place"])
def test_a_loop_is_clear_among_all_stretches_of_a_broken_drive(away: float, closed: bool) -> None:
    """The street is in the map twice: the odometry was lost between its two stretches. Then two visits follow.

    Previously, places of another stretch were not compared: in a warehouse wrong aisles fitted to 92 %, as did the
    right one.
    """
    visits = [(s, 1.0, 0.0) for s in (62.0, 67.0)]
    at = [(s, 0.0, 0.0) for s in (*STREET, *STREET)] + visits
    poses = np.array([where(*place) for place in at])
    poses[len(STREET) : 2 * len(STREET), 1, 3] += away
    search, loops = closer(), list[Edge]()
    clouds, keyframes = [scan(*place) for place in at], list[Keyframe]()
    for i, place in enumerate(at):
        broken = i in (len(STREET), 2 * len(STREET))
        edge = Registration(np.eye(4), 100 * np.eye(6) if broken else FIRM, 1.0, 0.1, "test") if i else None
        keyframes.append(Keyframe(i, i, i, poses[i], clouds[i], edge, "", described(*place)))
        if i >= 2 * len(STREET):
            loops += search.close(keyframes, clouds, poses[: i + 1], ONE_PART[: i + 1])
    assert any(loop.ok for loop in loops) == closed
    alike = [loop for loop in loops if loop.registration.reason.startswith("two places of the map fit alike")]
    assert bool(alike) != closed


@pytest.mark.slow
@pytest.mark.weights
@pytest.mark.parametrize(("things", "closed"), [(BOTH_ENDS, False), (np.concatenate([BOTH_ENDS, CABINET]), True)])
def test_a_second_drive_in_a_room_that_looks_the_same_from_its_other_end(things: Array, closed: bool) -> None:
    """A loop joins the second drive to the first if the ends can be distinguished. If not, 3 of 8 were previously
    joined in the wrong orientation."""
    truth = np.array([standing(*place) for place in ROUND + ROUND])
    way, keyframes, clouds, loops = make_loops(SlamSettings()), list[Keyframe](), list[Points](), list[Edge]()
    for i, T in enumerate(truth):
        edge = Registration(np.eye(4), FIRM, 1.0, 0.1, "test") if i % len(ROUND) else None
        clouds.append(room_scan(T, HALL, things, i))
        keyframes.append(way.described(Keyframe(i, i, i, T, clouds[-1], edge)))
        parts = np.arange(i + 1) // len(ROUND)
        loops += way.close(keyframes, clouds, truth[: i + 1], parts)
    accepted = [loop for loop in loops if loop.ok and loop.from_node < len(ROUND) <= loop.to_node]
    assert bool(accepted) == closed
    assert max(errors(accepted, truth), default=0.0) < 0.1


@pytest.mark.slow
@pytest.mark.weights
def test_what_the_odometry_would_reject_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 65 m the drive is 300 m away by its odometry, but has covered only 60 m: no place of the street can be the
    current one."""
    asked = list[int]()
    similar = PlaceRecognition.similar

    def counted(self: PlaceRecognition, descriptors: Descriptors, allowed: NDArray[np.bool_], count: int) -> list[int]:
        asked.append(int(allowed.sum()))
        return similar(self, descriptors, allowed, count)

    monkeypatch.setattr(PlaceRecognition, "similar", counted)
    jump = se3.exp(np.array([0, 0, 0, 0, 300.0, 0]))
    loops, _ = drive([(65.0, 0.0, 0.0)], jump, gap=30.0)
    assert asked[-1] == 0
    assert all(loop.to_node < len(STREET) for loop in loops)


@pytest.mark.slow
def test_without_descriptors_the_pose_alone_leads_to_loops_but_of_one_that_borrows() -> None:
    """A keyframe that borrows has the cloud of another keyframe, which is no independent evidence."""
    jump = se3.exp(np.array([0, 0, 0, 0.5, 0.5, 0]))
    at = [(s, 0.0, 0.0) for s in STREET] + [(62.0, 1.0, 0.0)]
    truth = np.array([where(*place) for place in at])
    poses = truth.copy()
    poses[-1] = jump @ poses[-1]
    search = closer(with_network=False, gap=30.0)
    clouds = [scan(*place) for place in at]
    keyframes = [
        Keyframe(i, i, i, poses[i], clouds[i], Registration(np.eye(4), FIRM, 1.0, 0.1, "test") if i else None)
        for i in range(len(at))
    ]
    assert search.described(keyframes[0]).descriptors is None
    own = np.arange(len(poses)) < len(STREET)
    assert closer(with_network=False, gap=30.0).close(keyframes, clouds, poses, ONE_PART[: len(poses)], own) == []
    (loop,) = search.close(keyframes, clouds, poses, ONE_PART[: len(poses)])
    assert loop.registration.ok, loop.registration.reason
    assert errors([loop], truth)[0] < 0.1


def test_disabled_it_closes_nothing_and_a_cloud_too_small_for_descriptors_is_no_failure() -> None:
    search = closer(enabled=False)
    tiny = Keyframe(0, 0, 0, np.eye(4), np.zeros((3, 4), np.float32), None)
    assert search.described(tiny).descriptors is None
    assert search.close([tiny, tiny], [tiny.cloud] * 2, np.array([np.eye(4)] * 2), ONE_PART[:2]) == []


@pytest.mark.slow
@pytest.mark.weights
def test_places_that_hardly_overlap_are_left_to_no_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop with an unlikely overlap is rejected with this reason, even if its descriptors match. NaN rejects none."""
    places = [(s, 2.5, 0.0) for s in (62.0, 67.0)]
    jump = se3.exp(np.array([0, 0, 0, 12.0, 0, 0]))  # the nearest keyframe by pose does not help

    def probability(value: float) -> Callable:
        def predict(
            decoder: Decoder, source: Tokens, target: Tokens, correlated: Correlated, solved: Solved
        ) -> torch.Tensor:
            return torch.full(source.mask.shape[:1], value)

        return predict

    reasons = []
    for value in (0.1, float("nan")):
        monkeypatch.setattr("dpm2_core.network.registrations.overlap_probability", probability(value))
        loops, _ = drive(places, jump, gap=30.0, consistency={"drift": 0.5})
        reasons.append([loop.registration.reason for loop in loops])
    assert any("overlap with a probability of only 0.10" in reason for reason in reasons[0])
    assert not any("overlap" in reason for reason in reasons[1])


@pytest.mark.slow
@pytest.mark.weights
def test_the_overlap_head_alone_accepts_the_best_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the paper: neither the points nor a second loop are checked. An untrained overlap head accepts nothing."""
    places, jump = [(62.0, 2.5, 0.0)], se3.exp(np.array([0, 0, 0, 12.0, 0, 0]))
    monkeypatch.setattr(Verifier, "verify", lambda *_: pytest.fail("the points were asked"))
    loops, truth = drive(places, jump, gap=30.0, decided_by="overlap", min_overlap=0.7)
    accepted = [loop for loop in loops if loop.registration.ok and loop.registration.reason == ""]
    assert len(accepted) == 1
    assert accepted[0].registration.overlap == max(loop.registration.overlap for loop in loops)
    assert errors(accepted, truth)[0] < 0.5  # the accuracy of the network's registration
    monkeypatch.setattr(
        "dpm2_core.network.registrations.overlap_probability",
        lambda decoder, source, *_: torch.full(source.mask.shape[:1], torch.nan),
    )
    loops, _ = drive(places, jump, gap=30.0, decided_by="overlap", min_overlap=0.7)
    assert not any(loop.registration.ok for loop in loops)
    assert "the overlap head of these weights is not trained" in {loop.registration.reason for loop in loops}


@cache
def car_park() -> World:
    return build_world("loop", "car_park", seed=902, length=120.0)


@cache
def in_the_car_park(s: float) -> tuple[Array, Points, Descriptors | None]:
    """Pose at `s` m of the trajectory, the cloud of a robot there, and its descriptors."""
    world = car_park()
    lidar, T = Lidar(real_sensor(LidarConfig(beams=16, height=0.8))), world.pose_at(s, height=0.8)
    points = lidar.scan(world, T, 0.5 * s, np.random.default_rng(int(s))).points
    cloud = points[voxel_first(points, 0.3, far=40.0)]
    return T, cloud, closer().described(Keyframe(0, 0, 0, np.eye(4), cloud)).descriptors


def joined(*ways: tuple[float, float]) -> tuple[list[Edge], Array]:
    """Loops between two robots in a car park that looks alike everywhere. Each robot drives one stretch (start, stop),
    m, of the same trajectory."""
    search, keyframes, clouds, truth, loops = closer(), list[Keyframe](), list[Points](), list[Array](), list[Edge]()
    for robot, (start, stop) in zip("ab", ways, strict=True):
        for s in np.arange(start, stop, 4.0):
            T, cloud, known = in_the_car_park(float(s))
            truth.append(T)
            clouds.append(cloud)
            edge = Registration(np.eye(4), FIRM, 1.0, 0.1, "test") if s > start else None
            keyframes.append(Keyframe(len(truth), 0, 0, T, cloud, edge, robot, known))
            of_robots = np.array([keyframe.robot == "b" for keyframe in keyframes], np.intp)
            loops += search.close(keyframes, clouds, np.array(truth), of_robots)
    return loops, np.array(truth)


@pytest.mark.slow
@pytest.mark.weights
def test_robots_in_different_parts_of_a_place_that_looks_alike_are_not_joined() -> None:
    loops, _ = joined((0.0, 40.0), (44.0, 80.0))
    assert any("no more than at a place that looks alike" in loop.registration.reason for loop in loops)
    assert not any(loop.ok for loop in loops)


@pytest.mark.slow
@pytest.mark.weights
def test_robots_that_meet_in_a_place_that_looks_alike_are_joined_where_they_do() -> None:
    loops, truth = joined((0.0, 40.0), (18.0, 40.0))
    accepted = [loop for loop in loops if loop.ok]
    assert len(accepted) >= 2
    assert max(errors(accepted, truth)) < 0.2
