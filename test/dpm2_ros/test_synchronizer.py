# SPDX-License-Identifier: Apache-2.0
"""Clouds set the pace; an image is matched in time or not at all; every loss is counted."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpm2_ros.synchronizer import FEW, HOLD, PATIENCE, Bundle, SensorState, StampCheck, Synchronizer

MS = 1_000_000


def make(camera: bool = True, depth: int = 10, timeout: float = 0.03, tolerance: float = 0.05) -> Synchronizer:
    return Synchronizer(["/image"] * camera, depth, timeout, tolerance)


def camera_of(synchronizer: Synchronizer) -> SensorState:
    return synchronizer.sensors["/image"]


def image_of(bundle: Bundle) -> Any:
    """The matched image of a bundle; None without one."""
    return bundle.beside.get("/image", (0, None))[1]


def drain(synchronizer: Synchronizer, now: float) -> list[Bundle]:
    return list(iter(lambda: synchronizer.pop(now), None))


def test_without_a_camera_nothing_waits() -> None:
    synchronizer = make(camera=False)
    synchronizer.add_cloud(100 * MS, "a", now=0.0)
    assert [bundle.cloud for bundle in drain(synchronizer, 0.0)] == ["a"]


def test_a_cloud_waits_for_all_other_sensors_alike() -> None:
    """Each sensor has its own patience: a silent sensor does not cost the images of the others."""
    topics = ("/image", "/second_image", "/lidar")
    synchronizer = Synchronizer(topics, depth=10, timeout=0.03, tolerance=0.05)
    synchronizer.add_cloud(100 * MS, "a", now=0.0)
    synchronizer.add("/image", 110 * MS, "image", now=0.01)
    synchronizer.add("/second_image", 140 * MS, "other", now=0.01)
    assert not drain(synchronizer, 0.01)
    synchronizer.add("/lidar", 60 * MS, "second", now=0.02)
    (bundle,) = drain(synchronizer, 0.02)
    assert bundle.beside == {
        "/image": (110 * MS, "image"), "/second_image": (140 * MS, "other"), "/lidar": (60 * MS, "second")
    }  # fmt: skip
    for n in range(2, 2 + PATIENCE):  # the first camera stops
        for topic in topics[1:]:
            synchronizer.add(topic, 100 * n * MS, n, now=0.1 * n)
        synchronizer.add_cloud(100 * n * MS, n, now=0.1 * n)
        assert not drain(synchronizer, 0.1 * n)
        (bundle,) = drain(synchronizer, 0.1 * n + 0.03)
        assert bundle.beside == dict.fromkeys(topics[1:], (100 * n * MS, n))
    synchronizer.add_cloud(2000 * MS, "last", now=2.0)
    synchronizer.add("/lidar", 2000 * MS, "second", now=2.01)
    assert not drain(synchronizer, 2.01)
    synchronizer.add("/second_image", 2000 * MS, "other", now=2.02)
    assert [bundle.cloud for bundle in drain(synchronizer, 2.02)] == ["last"]  # clouds no longer wait for the first
    counts = [(synchronizer.sensors[topic].matched, synchronizer.sensors[topic].missed) for topic in topics]
    assert counts == [(1, PATIENCE + 1), (PATIENCE + 2, 0), (PATIENCE + 2, 0)]


@pytest.mark.parametrize(("depth", "behind", "rate"), [(10, 9, 60), (100, 12, 30), (100, 50, 10)])
def test_clouds_that_wait_for_the_worker_keep_their_images(depth: int, behind: int, rate: int) -> None:
    """Clouds keep their images, however many images arrive while the worker is behind."""
    synchronizer, out = make(depth=depth), list[Bundle]()
    clouds = [(0.1 * n, True) for n in range(60)]
    for now, is_cloud in sorted([*clouds, *((n / rate, False) for n in range(6 * rate))]):
        if is_cloud:
            synchronizer.add_cloud(round(now * 1000) * MS, now, now)
        else:
            synchronizer.add("/image", round(now * 1000) * MS, now, now)
        if len(synchronizer) > behind:
            out += filter(None, [synchronizer.pop(now)])
    assert len(out) >= 60 - behind - 1
    assert all(abs(image_of(bundle) - bundle.cloud) < 1e-3 for bundle in out)  # an image for each, but for rounding


def test_a_camera_that_nobody_publishes_is_not_waited_for() -> None:
    """Clouds do not wait for a camera without a publisher, or one that has disappeared; images that it has delivered
    are used."""
    synchronizer = make()
    camera_of(synchronizer).present = False
    synchronizer.add_cloud(100 * MS, "a", now=0.0)
    assert [bundle.cloud for bundle in drain(synchronizer, 0.0)] == ["a"]
    synchronizer.add("/image", 200 * MS, "image", now=0.1)
    synchronizer.add_cloud(200 * MS, "b", now=0.1)
    assert [image_of(bundle) for bundle in drain(synchronizer, 0.1)] == ["image"]


@pytest.mark.parametrize(
    ("image_stamp_ms", "arrives_s", "joins"),
    [
        (100, 0.00, True),  # together with the cloud
        (149, 0.02, True),  # at the edge of the tolerance, within the timeout
        (51, 0.029, True),  # earlier than the cloud by the tolerance
        (151, 0.00, False),  # beyond the tolerance
        (100, 0.04, False),  # too late
    ],
)
def test_an_image_joins_within_timeout_and_tolerance(image_stamp_ms: int, arrives_s: float, joins: bool) -> None:
    synchronizer = make()
    synchronizer.add_cloud(100 * MS, "cloud", now=0.0)
    if arrives_s < 0.03:
        synchronizer.add("/image", image_stamp_ms * MS, "image", now=arrives_s)
    (bundle,) = drain(synchronizer, now=0.03)
    assert image_of(bundle) == ("image" if joins else None)


def test_a_cloud_waits_for_its_image_and_no_longer() -> None:
    synchronizer = make()
    synchronizer.add_cloud(100 * MS, "cloud", now=1.0)
    assert synchronizer.pop(1.029) is None
    assert synchronizer.deadline() == pytest.approx(1.03)
    assert synchronizer.pop(1.03) is not None


def test_a_later_image_ends_the_wait() -> None:
    """Once an image is later than the cloud, the cloud's image can no longer arrive."""
    synchronizer = make()
    synchronizer.add_cloud(100 * MS, "cloud", now=0.0)
    synchronizer.add("/image", 200 * MS, "next", now=0.0)
    assert synchronizer.pop(0.0) is not None


def test_the_nearest_of_several_images_is_taken() -> None:
    synchronizer = make()
    for stamp in (60, 97, 140):
        synchronizer.add("/image", stamp * MS, stamp, now=0.0)
    synchronizer.add_cloud(100 * MS, "cloud", now=0.0)
    assert image_of(drain(synchronizer, 0.0)[0]) == 97


def test_an_image_that_came_too_late_for_one_cloud_may_be_the_next_ones() -> None:
    """It is within the tolerance of both; although the first cloud did not wait for it, the second may use it."""
    synchronizer = make()
    synchronizer.add_cloud(100 * MS, "a", now=0.0)
    assert [image_of(bundle) for bundle in drain(synchronizer, 0.03)] == [None]
    synchronizer.add("/image", 140 * MS, "image", now=0.04)
    synchronizer.add_cloud(160 * MS, "b", now=0.06)
    assert [image_of(bundle) for bundle in drain(synchronizer, 0.06)] == ["image"]
    assert camera_of(synchronizer).late == 1


def test_a_camera_that_comes_late_in_the_drive_is_used_from_then_on() -> None:
    """Its images arrive shortly after the clouds: too late for a cloud that does not wait, in time for one that
    does."""
    synchronizer = make()
    joined = []
    for n in range(3 * PATIENCE):
        arrival = 0.1 * n
        synchronizer.add_cloud((100 + 100 * n) * MS, n, arrival)
        taken = drain(synchronizer, arrival)
        if n >= 2 * PATIENCE:
            synchronizer.add("/image", (100 + 100 * n) * MS, n, arrival + 0.01)
        taken += drain(synchronizer, arrival + 0.05)
        joined += [image_of(bundle) is not None for bundle in taken]
    assert joined == [False] * (2 * PATIENCE + 1) + [True] * (PATIENCE - 1)


def test_a_camera_that_is_always_too_late_costs_no_latency() -> None:
    synchronizer = make()
    for n in range(20):
        synchronizer.add_cloud((100 + 100 * n) * MS, n, 0.1 * n)
        waits = synchronizer.pop(0.1 * n) is None
        assert waits == (n < PATIENCE)
        drain(synchronizer, 0.1 * n + 0.03)
        synchronizer.add("/image", (100 + 100 * n) * MS, n, 0.1 * n + 0.07)
    assert camera_of(synchronizer).late == 20


@pytest.mark.parametrize("ahead", [-37, -0.3, 37])
def test_a_camera_of_another_clock_costs_no_latency_and_is_said(ahead: float) -> None:
    """The stamps may be off by leap seconds, if the driver counts them, or by little. Previously, each image made the
    next clouds wait."""
    synchronizer, waited = make(), list[bool]()
    for n in range(20):
        synchronizer.add("/image", round(100 + 100 * n + 1000 * ahead) * MS, n, 0.1 * n)
        synchronizer.add_cloud((100 + 100 * n) * MS, n, 0.1 * n + 0.01)
        waited.append(synchronizer.pop(0.1 * n + 0.01) is None)
        drain(synchronizer, 0.1 * n + 0.05)
    assert waited == [n < PATIENCE for n in range(20)]
    assert not camera_of(synchronizer).fits


def test_a_camera_beside_a_slow_lidar_is_waited_for() -> None:
    """Camera and LiDAR each send one message every 2 s: this does not indicate another clock."""
    synchronizer, joined = make(), list[bool]()
    for n in range(20):
        synchronizer.add_cloud((100 + 2000 * n) * MS, n, 2.0 * n)
        assert synchronizer.pop(2.0 * n) is None
        synchronizer.add("/image", (100 + 2000 * n) * MS, n, 2.0 * n + 0.02)
        joined += [image_of(bundle) is not None for bundle in drain(synchronizer, 2.0 * n + 0.02)]
    assert joined == [True] * 20


@pytest.mark.parametrize(("late", "fits"), [(0.0, True), (0.09, False)])
def test_a_slow_camera_fits_where_its_images_are_used(late: float, fits: bool) -> None:
    """For 2 Hz images and 20 Hz clouds, most clouds have no image. The camera fits if its images have clouds, and does
    not if they are too late."""
    synchronizer, said = make(), list[bool]()
    for tick in range(2000):  # 10 ms
        now = 0.01 * tick
        if tick % 50 == round(100 * late):
            synchronizer.add("/image", (100 + 10 * tick - round(1000 * late)) * MS, tick, now)
        if tick % 5 == 0:
            synchronizer.add_cloud((100 + 10 * tick) * MS, tick, now)
        drain(synchronizer, now)
        said.append(camera_of(synchronizer).fits)
    assert set(said[-1000:]) == {fits}


@pytest.mark.parametrize("images", [0, 5], ids=["never comes", "stops"])
def test_a_camera_that_brings_no_more_is_given_up_after_some_frames(images: int) -> None:
    synchronizer = make()
    for n in range(20):
        if n < images:
            synchronizer.add("/image", (100 + 100 * n) * MS, n, 0.1 * n)
        synchronizer.add_cloud((100 + 100 * n) * MS, n, 0.1 * n)
        waits = synchronizer.pop(0.1 * n) is None
        assert waits == (images <= n < images + PATIENCE)
        drain(synchronizer, 0.1 * n + 0.03)
    assert camera_of(synchronizer).matched == images
    assert not camera_of(synchronizer).awaited


def test_a_full_queue_drops_the_oldest_and_counts() -> None:
    synchronizer = make(depth=3)
    for n in range(5):
        synchronizer.add_cloud(100 * (1 + n) * MS, n, now=0.0)
    assert [(bundle.cloud, bundle.dropped) for bundle in drain(synchronizer, 1.0)] == [(2, 2), (3, 0), (4, 0)]
    assert synchronizer.dropped == 2


def released_parts(synchronizer: Synchronizer, seconds: float, takes: Callable[[int], float]) -> list[Bundle]:
    """The bundles of a worker that needs `takes` s for each part of a sweep, by its number; they come at 100 Hz."""
    got, free = list[Bundle](), 0.0
    for part in range(round(100 * seconds)):
        now = 0.01 * part
        synchronizer.add_cloud(round(now * 1e9), part, now)
        while free <= now and (bundle := synchronizer.pop(now)) is not None:
            got.append(bundle)
            free = max(free, now - 0.01) + takes(len(got))
    return got


def test_parts_of_a_sweep_wait_as_long_as_sweeps() -> None:
    """While one sweep took 0.9 s, 81 parts were dropped, but of clouds at 10 Hz none."""
    synchronizer = make(camera=False)
    got = released_parts(synchronizer, 4.0, lambda number: 0.9 if number == 50 else 0.05 * (number % 10 == 0))
    assert synchronizer.dropped == 0
    assert [bundle.cloud for bundle in got] == list(range(400))


def test_of_parts_of_a_sweep_whole_sweeps_are_dropped() -> None:
    """A worker that was too slow for them got sweeps with holes, which could not be registered."""
    synchronizer = make(camera=False)
    got = released_parts(synchronizer, 20.0, lambda number: 0.015)
    assert synchronizer.dropped > 500
    assert min(bundle.dropped for bundle in got if bundle.dropped) >= 10
    assert got[-1].arrival > 19.0


def driven(synchronizer: Synchronizer, takes: float, until: float, image_late: float | None = None) -> list[Bundle]:
    """The bundles of a worker that needs `takes` s per cloud, at 10 Hz; their arrival is replaced by the delay."""
    got, free, step = list[Bundle](), 0.0, 0.01
    for tick in range(round(until / step)):
        now = tick * step
        if tick % 10 == 0:
            synchronizer.add_cloud(tick * 10 * MS, tick, now)
        if image_late is not None and (due := tick - round(image_late / step)) >= 0 and due % 10 == 0:
            synchronizer.add("/image", due * 10 * MS, due, now)
        if now >= free and (bundle := synchronizer.pop(now)) is not None:
            bundle.arrival, free = now - bundle.arrival, now + takes
            got.append(bundle)
    return got


def test_a_worker_that_is_too_slow_gets_clouds_that_are_not_old() -> None:
    """Of 10 clouds 8 can be processed: two are lost in any case, but after a while clouds wait FEW periods, not 10.
    No gap until then is longer than three periods."""
    synchronizer = make(camera=False)
    got = driven(synchronizer, takes=0.125, until=60)
    assert max(bundle.arrival for bundle in got) <= 1.15  # 10 waiting, and the rest of the one before
    assert max(bundle.arrival for bundle in got[len(got) // 2 :]) <= (FEW + 1) * 0.1
    assert max(b.stamp - a.stamp for a, b in pairwise(got)) <= 300 * MS
    assert len(got) == pytest.approx(60 / 0.125, rel=0.05)


def test_a_worker_that_has_caught_up_may_fall_behind_again_without_loss() -> None:
    """A second of overload in an hour costs nothing, also after a long overload."""
    synchronizer = make(camera=False)
    driven(synchronizer, takes=0.125, until=60)
    at, dropped = 60.0, synchronizer.dropped
    drain(synchronizer, at)
    for n in range(10):
        synchronizer.add_cloud((60_000 + 100 * n) * MS, n, now=at + 0.1 * n)
    assert synchronizer.dropped == dropped
    assert len(drain(synchronizer, at + 1)) == 10


def test_a_worker_that_is_held_up_loses_only_what_does_not_fit() -> None:
    synchronizer = make(camera=False, depth=10)
    drain(synchronizer, 0.0)
    for n in range(15):  # while the worker is busy with something else
        synchronizer.add_cloud(100 * n * MS, n, now=0.1 * n)
    assert [bundle.cloud for bundle in drain(synchronizer, 1.5)] == list(range(5, 15))


def test_images_that_come_late_starve_no_worker() -> None:
    """Each is 0.3 s later than its cloud, longer than FEW clouds: a worker that waits for images is not behind."""
    synchronizer = make(timeout=1.0)
    got = driven(synchronizer, takes=0.12, until=60, image_late=0.3)
    assert len(got) > 0.9 * 60 / 0.12
    assert sum(image_of(bundle) is not None for bundle in got) > 0.8 * len(got)


@pytest.mark.parametrize(
    ("stamp_ms", "check"),
    [
        (10_000, StampCheck.REPEATED),
        (9_900, StampCheck.OUT_OF_ORDER),
        (9_000, StampCheck.OUT_OF_ORDER),
        (8_999, StampCheck.JUMPED),
        (10_001, StampCheck.ACCEPTED),
        (11_100, StampCheck.ACCEPTED),  # a second beyond the 0.1 s that have passed
        (11_101, StampCheck.JUMPED),
    ],
)
def test_stamps_that_repeat_jump_back_or_forward(stamp_ms: int, check: StampCheck) -> None:
    synchronizer = make(camera=False)
    synchronizer.add_cloud(10_000 * MS, "before", now=0.0)
    assert synchronizer.add_cloud(stamp_ms * MS, "after", now=0.1) is check
    left = drain(synchronizer, 0.1)
    assert [bundle.cloud for bundle in left] == ["before"] + ["after"] * (check is StampCheck.ACCEPTED)
    if check is not StampCheck.JUMPED:
        assert synchronizer.counts[check] == 1 + (check is StampCheck.ACCEPTED)


@pytest.mark.parametrize(("clock", "stepped"), [((50.0, 53.0), False), ((50.0, 50.1), True), ((0.0, 53.0), True)])
def test_a_gap_of_a_recording_that_is_played_faster_is_a_pause(clock: tuple[float, float], stepped: bool) -> None:
    """The pause is recognized by /clock, if it covers both clouds; a clock set during the recording is not a pause."""
    synchronizer = make(camera=False)
    synchronizer.add_cloud(10_000 * MS, "before", now=0.0, clock=clock[0])
    check = synchronizer.add_cloud(13_000 * MS, "after", now=0.1, clock=clock[1])
    assert (check is StampCheck.JUMPED) == stepped
    assert [bundle.stepped for bundle in drain(synchronizer, 1.0)] == [False, stepped]


def feed(synchronizer: Synchronizer, *stamps_ms: int, period: float = 0.1) -> list[tuple[int, bool]]:
    """Add clouds at a steady pace; stamp (ms) and `restarted` of those that are released."""
    out = []
    for n, stamp in enumerate(stamps_ms):
        synchronizer.add_cloud(stamp * MS, stamp, now=period * n)
        out += drain(synchronizer, period * n)
    return [(bundle.cloud, bundle.restarted) for bundle in out]


@pytest.mark.parametrize("stray", [10_000 + 86_400_000, 12_000, 10_900, 10_450, 0, 8_000])
def test_one_stamp_far_off_costs_its_cloud_alone(stray: int) -> None:
    """After one stamp far ahead or behind, the following clouds continue the drive, and nothing restarts."""
    synchronizer = make(camera=False)
    assert feed(synchronizer, 9_900, 10_000, stray, 10_200, 10_300) == [
        (stamp, False) for stamp in (9_900, 10_000, 10_200, 10_300)
    ]
    assert synchronizer.counts[StampCheck.STRAY] == 1
    assert synchronizer.counts[StampCheck.RESTARTED] == 0


def test_a_jump_back_that_lasts_is_a_restart_and_loses_nothing() -> None:
    """After a looped bag or a clock that was set, a step back of 1.5 s suffices for a restart; no cloud is lost."""
    for first in (0, 8_600):
        synchronizer = make(camera=False)
        stamps = (9_900, 10_000, first, first + 100, first + 200)
        assert feed(synchronizer, *stamps) == [(stamp, stamp == first) for stamp in stamps]
        assert synchronizer.counts[StampCheck.RESTARTED] == 1
        assert sum(synchronizer.counts.values()) == 5


@pytest.mark.parametrize("back", [150, 250, 350, 500, 900])
def test_a_clock_that_is_set_back_by_less_than_a_second_loses_nothing(back: int) -> None:
    """After an NTP client sets the clock back, the drive continues, with its clouds in the order of their arrival."""
    synchronizer = make(camera=False)
    stamps = [9_901, 10_001, *(stamp - back for stamp in range(10_100, 11_600, 100))]
    assert feed(synchronizer, *stamps) == [(stamp, False) for stamp in stamps]
    assert synchronizer.counts[StampCheck.ACCEPTED] == len(stamps)


def test_three_clouds_that_come_too_late_are_rejected() -> None:
    """Clouds that were delayed in transit, or come from a second publisher, are rejected if at most three arrive in a
    row."""
    synchronizer = make(camera=False)
    late = (9_500, 9_600, 9_700, 10_100, 9_800, 9_900, 10_000, 10_200, 10_140, 10_130, 10_120, 10_110, 10_300)
    kept = [10_000, 10_100, 10_200, 10_300]
    assert feed(synchronizer, 10_000, *late) == [(stamp, False) for stamp in kept]
    assert synchronizer.counts[StampCheck.OUT_OF_ORDER] == 10


def test_a_jump_ahead_that_lasts_loses_nothing() -> None:
    """No cloud is lost after a gap of a recording that is played without the pause, or after a clock was set."""
    stamps = (9_900, 10_000, 15_000, 15_100)
    assert feed(make(camera=False), *stamps) == [(stamp, False) for stamp in stamps]


def test_a_jump_ahead_is_told_from_a_pause() -> None:
    """The elapsed time distinguishes them, also if the cloud that jumped had to be dropped."""
    for arrival, stepped in ((0.1, True), (5.0, False)):
        synchronizer = make(camera=False)
        out = []
        for stamp, now in ((10_000, 0.0), (15_000, arrival), (15_100, arrival + 0.1)):
            synchronizer.add_cloud(stamp * MS, stamp, now)
            out += drain(synchronizer, now)
        assert [bundle.stepped for bundle in out] == [False, stepped, False]
    synchronizer = make(camera=False, depth=2)
    for stamp in (10_000, 15_000, 15_100, 15_200):
        synchronizer.add_cloud(stamp * MS, stamp, now=0.0)
    assert [(b.cloud, b.stepped) for b in drain(synchronizer, 0.0)] == [(15_100, True), (15_200, False)]


@pytest.mark.parametrize("ahead", [400, 600, 900, 5_000])
@pytest.mark.parametrize(
    ("arrivals", "stepped"),
    [((0.1, 0.2, 0.3, 0.4), True), ((0.1, 0.5, 0.6, 0.7), False), ((0.1, 0.11, 0.2, 0.3), False)],
    ids=["at once", "after a while", "kept on the way"],
)
def test_a_clock_that_is_set_ahead_is_told_by_the_pace_of_the_clouds(
    ahead: int, arrivals: tuple[float, ...], stepped: bool
) -> None:
    """Steps of less than a second are detected, too: 0.6 and 0.95 s on KITTI 04 and 00 led to errors of 8 to 13 m, lost
    and broken."""
    synchronizer, out = make(camera=False), list[Bundle]()
    stamps = (9_900, 10_000, 10_100 + ahead, 10_200 + ahead, 10_300 + ahead)
    for stamp, now in zip(stamps, (0.0, *arrivals), strict=True):
        synchronizer.add_cloud(stamp * MS, stamp, now)
        out += drain(synchronizer, now)
    assert [bundle.cloud for bundle in out] == list(stamps)
    assert [bundle.stepped for bundle in out] == [False, False, stepped or ahead > 1_000, False, False]


@pytest.mark.parametrize("ahead", [11_000, 10_300, 10_150])
def test_a_stamp_ahead_costs_no_more_than_what_its_cloud_overtakes(ahead: int) -> None:
    """A stamp less than three periods ahead cannot be told from a pause: clouds until then are lost, all others are
    released."""
    synchronizer = make(camera=False)
    true = range(10_000, 11_600, 100)
    stamps = [ahead if stamp == 10_200 else stamp for stamp in true]
    left = [stamp for stamp, _ in feed(synchronizer, *stamps)]
    lost = set(true) - set(left)
    assert lost <= {10_200, 10_300}
    assert left == sorted(left)


def test_a_burst_of_which_the_middle_was_lost_loses_nothing_more() -> None:
    """If a link delivers delayed clouds late, the clouds around a gap arrive at the same time, and no clock was set."""
    stamps, out = [10_000, 10_100, 10_200, 10_900, 11_000, 11_100], []
    synchronizer = make(camera=False, depth=8)
    for stamp, now in zip(stamps, (0.0, 0.1, 1.2, 1.2, 1.2, 1.2), strict=True):
        synchronizer.add_cloud(stamp * MS, stamp, now)
        out += drain(synchronizer, now)
    assert [(bundle.cloud, bundle.stepped) for bundle in out] == [(stamp, False) for stamp in stamps]


def test_a_pause_of_the_sensor_is_no_jump() -> None:
    synchronizer = make(camera=False)
    synchronizer.add_cloud(10_000 * MS, "a", now=0.0)
    assert synchronizer.add_cloud(20_000 * MS, "b", now=10.1) is StampCheck.ACCEPTED


def test_a_jump_that_nothing_follows_is_believed_after_a_while() -> None:
    """A sender that waits for the pose of one cloud before it sends the next receives that pose."""
    synchronizer = make(camera=False)
    synchronizer.add_cloud(10_000 * MS, "a", now=0.0)
    drain(synchronizer, 0.0)
    synchronizer.add_cloud(1_000 * MS, "b", now=0.1)
    assert synchronizer.pop(0.1 + HOLD - 0.01) is None
    assert synchronizer.deadline() == pytest.approx(0.1 + HOLD)
    bundle = synchronizer.pop(0.1 + HOLD)
    assert bundle is not None
    assert (bundle.cloud, bundle.restarted) == ("b", True)


def test_a_restart_survives_the_drop_of_its_cloud() -> None:
    synchronizer = make(camera=False, depth=2)
    for stamp in (10_000, 1_000, 1_100, 1_200):
        synchronizer.add_cloud(stamp * MS, stamp, now=0.0)
    assert [(b.cloud, b.restarted) for b in drain(synchronizer, 0.0)] == [(1_100, True), (1_200, False)]


def test_images_join_again_after_a_restart() -> None:
    synchronizer = make()
    joined = []
    for n, stamp in enumerate((10_000, 10_100, 1_000, 1_100)):
        synchronizer.add("/image", stamp * MS, stamp, now=0.1 * n)
        synchronizer.add_cloud(stamp * MS, stamp, now=0.1 * n)
        joined += [image_of(bundle) for bundle in drain(synchronizer, 0.1 * n)]
    assert joined == [10_000, 10_100, 1_000, 1_100]


@given(
    events=st.lists(
        st.tuples(st.sampled_from(["cloud", "image"]), st.integers(0, 60), st.floats(0, 0.05)), max_size=60
    ),
    depth=st.integers(1, 5),
)
def test_every_cloud_leaves_once_or_is_counted(events: list[tuple[str, int, float]], depth: int) -> None:
    """For any input in any order, accepted clouds are released in order, each once; images are within the tolerance."""
    synchronizer, now, given_in, out = make(depth=depth), 0.0, [], []
    for what, stamp, pause in events:
        now += pause
        if what == "cloud":
            synchronizer.add_cloud(stamp * 50 * MS, stamp * 50 * MS, now)
            given_in.append(stamp * 50 * MS)
        else:
            synchronizer.add("/image", stamp * 50 * MS, stamp * 50 * MS, now)
        out += drain(synchronizer, now)
    out += drain(synchronizer, now + 1)
    assert len(synchronizer) == 0
    counts = synchronizer.counts
    assert sum(counts.values()) == len(given_in)
    assert len(out) + synchronizer.dropped == counts[StampCheck.ACCEPTED] + counts[StampCheck.RESTARTED]
    remaining = iter(given_in)
    assert all(bundle.cloud in remaining for bundle in out)  # a subsequence: same order, none twice
    assert all(abs(image_of(bundle) - bundle.stamp) <= 50 * MS for bundle in out if image_of(bundle) is not None)
