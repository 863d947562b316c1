# SPDX-License-Identifier: Apache-2.0
"""Images constrain the direction that scans leave open: a corridor of constant cross section with painted walls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.open import open_source
from dpm2_core.data.thumbnail import usable_image
from dpm2_core.estimates import Registration, State
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_odometry, make_registration, make_slam
from dpm2_core.slam.registration.protocol import Prediction
from dpm2_core.slam.registration.texture import VisualSettings
from dpm2_core.slam.settings import SlamSettings

from ....helpers.corridor import CAMERA, T_LIDAR_CAM, Paint, frame, random_paint, seen, stripes, with_intensities
from ....helpers.drives import track

GEOMETRIC = SlamSettings(registration="geometric")
"""Images are processed in the same way with the network, which takes most of the time."""


def registered(first: Frame, second: Frame, **visual: object) -> Registration:
    """Registration of the second frame in the frame of the first."""
    settings = VisualSettings.model_validate(visual)
    registration = make_registration(SlamSettings(registration="geometric", visual=settings))
    registration.update(registration.prepare(first, np.zeros(6)), np.eye(4))
    result = registration.register(registration.prepare(second, np.zeros(6)), Prediction([np.eye(4)]))
    assert result.ok
    return result


def assert_same(one: Registration, other: Registration) -> None:
    assert np.array_equal(one.T_target_source, other.T_target_source)
    assert np.array_equal(one.covariance, other.covariance)
    assert (one.method, one.reason) == (other.method, other.reason)


@pytest.mark.slow
def test_the_way_along_a_corridor_is_read_from_its_walls() -> None:
    """1.7 m that no point constrains are found to 3 cm, one step of the fine search, at any exposure. The covariance
    shows it."""
    paint = random_paint()
    first, second = frame(0.0, paint), frame(1.7, paint, 1, gain=0.6)
    blind = registered(first, second, enabled=False)
    assert blind.method == "geometric"
    assert np.sqrt(blind.covariance[3, 3]) > 0.3
    assert abs(blind.T_target_source[0, 3] - 1.7) > 0.5
    found = registered(first, second)
    assert found.method == "visual"
    assert found.T_target_source[0, 3] == pytest.approx(1.7, abs=0.03)
    np.testing.assert_allclose(found.T_target_source[1:3, 3], 0, atol=0.03)
    assert np.sqrt(np.linalg.eigvalsh(found.covariance)[-1]) < 0.1
    # An image shows the scene, but not the calibration errors, which grow with the distance that it determines.
    assert found.floor[1] == pytest.approx(0.006 * 1.7, rel=0.05)
    assert np.linalg.eigvalsh(found.of_scene)[0] > 0
    assert found.of_scene[3, 3] < blind.of_scene[3, 3] / 9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("paint", "why"),
    [(stripes, "several places are alike"), (lambda p: np.full(len(p), 99.0), "no place correlates by 0.30")],
)
def test_an_image_that_does_not_constrain_is_not_used(paint: Paint, why: str) -> None:
    """Paint that repeats, or none: the result stays that of the points, with their uncertainty, and reports the
    reason."""
    result = registered(frame(0.0, paint), frame(0.7, paint, 1))
    assert result.method == "geometric"
    assert why in result.reason
    assert np.sqrt(result.covariance[3, 3]) > 0.3
    assert np.isfinite(result.T_target_source).all()


@pytest.mark.slow
def test_a_camera_that_shows_no_point_is_said_and_not_used() -> None:
    """The camera looks backwards while the LiDAR only sees ahead, or its pose is not that of the optical frame.
    Previously, it ended the run."""
    paint = random_paint()
    back = replace(CAMERA, T_lidar_cam=np.diag([-1.0, -1, 1, 1]) @ T_LIDAR_CAM)
    first, second = (
        replace(f, points=f.points[f.points[:, 0] > 1], images=(seen(x, paint, back),))
        for x, f in ((0.0, frame(0.0, paint)), (1.7, frame(1.7, paint, 1)))
    )
    result = registered(first, second)
    assert (result.method, result.reason) == ("geometric", "image: only 0 points in it")


@pytest.mark.slow
def test_without_images_nothing_changes() -> None:
    """Frames whose camera fails are processed as before."""
    paint = random_paint()
    first, second = (Frame(f.stamp, f.points, index=f.index) for f in (frame(0.0, paint), frame(0.2, paint, 1)))
    assert_same(registered(first, second), registered(first, second, enabled=False))


@pytest.mark.slow
def test_of_two_cameras_the_first_is_asked_and_the_second_where_it_has_no_image() -> None:
    """An image is never compared with one of the other camera: they show different walls, or none in common."""
    paint, back = random_paint(), np.diag([-1.0, -1, 1, 1])
    rear = replace(CAMERA, T_lidar_cam=back @ T_LIDAR_CAM, name="rear")
    two = [replace(f, images=(*f.images, seen(x, paint, rear))) for x, f in
           ((0.0, frame(0.0, paint)), (1.7, frame(1.7, paint, 1)))]  # fmt: skip
    first, second = ([replace(f, images=(f.images[n],)) for f in two] for n in (0, 1))
    assert_same(registered(*two), registered(two[0], first[1]))
    by_second = registered(second[0], two[1])
    assert by_second.method == "visual"
    assert by_second.T_target_source[0, 3] == pytest.approx(1.7, abs=0.03)
    by_none = registered(two[0], second[1])
    assert by_none.method == "geometric"
    assert "image" not in by_none.reason


@pytest.mark.slow
@pytest.mark.parametrize(("focal", "apart"), [(1.0, False), (1.1, True)])
def test_a_camera_whose_calibration_is_wrong_leads_nowhere_where_intensities_tell(focal: float, apart: bool) -> None:
    """By the image alone, 10 % of the focal length are an error of 4 m in 39 m, as `tracking`. Intensities have no
    calibration."""
    paint, states, reasons, ahead = random_paint(), [], [], []
    camera = replace(CAMERA, K=CAMERA.K @ np.diag([focal, focal, 1.0]))
    odometry = make_odometry(GEOMETRIC)
    way = np.cumsum(np.interp(np.arange(60), [0, 20, 40], [0.6, 0.6, 0.9]))
    for i, x in enumerate(way):
        one = with_intensities(frame(x, paint, i), x, paint)
        tracked = odometry.process(replace(one, images=(replace(one.images[0], camera=camera),)))
        ahead.append(tracked.T_odom_lidar[0, 3] - x)
        states.append(tracked.state)
        reasons.append(tracked.registration.reason)
    assert np.ptp(ahead[8:]) < 0.2  # two scans' worth of cells; the image's 4 m are 20 times that
    assert any("image and intensities" in reason for reason in reasons[8:]) == apart
    assert (State.DEGRADED in states[8:]) == apart


def noisy(one: Frame) -> Frame:
    """The frame with camera noise, so that no two images are the same."""
    noise = np.random.default_rng(one.index).integers(0, 3, one.images[0].pixels.shape, np.uint8)
    return replace(one, images=tuple(replace(i, pixels=np.minimum(i.pixels, 253) + noise) for i in one.images))


@pytest.mark.slow
@pytest.mark.parametrize(
    "hangs",
    [
        pytest.param(lambda i: i > 5, id="for good"),
        pytest.param(lambda i: i > 5 and i % 2 == 0, id="every other", marks=pytest.mark.long),
    ],
)
def test_an_image_that_is_sent_again_is_left_out(hangs: Callable[[int], bool]) -> None:
    """A camera that hangs sends it. Previously, it showed a halt, and the error was the distance traveled meanwhile, as
    `tracking`."""
    paint = random_paint(3)
    good = [noisy(frame(0.5 * i, paint, i)) for i in range(10)]
    hung = [replace(f, images=good[5 if hangs(7) else i - 1].images) if hangs(i) else f for i, f in enumerate(good)]
    without = [replace(f, images=()) if hangs(i) else f for i, f in enumerate(good)]
    odometry = [make_odometry(SlamSettings()) for _ in range(2)]  # the network does not receive it either
    for i, (one, other) in enumerate(zip(hung, without, strict=True)):
        result, expected = odometry[0].process(one), odometry[1].process(other)
        assert_same(result.registration, expected.registration)
        assert ("the same image as before" in result.camera) == hangs(i)
    if hangs(9):
        assert result.state is not State.TRACKING


@pytest.mark.slow
def test_a_camera_of_another_rate_than_the_scans() -> None:
    """With 15 Hz next to 10 Hz at 10 m/s, every second image is 0.33 m from its scan. Previously, that was the error of
    each step."""
    paint, late = random_paint(3), np.arange(10) % 2 / 30
    frames = [frame(1.0 * i, paint, i) for i in range(10)]
    odometry, tracked = make_odometry(GEOMETRIC), []
    for i, one in enumerate(frames):
        image = replace(seen(i + 10 * late[i], paint, CAMERA), time_offset=late[i])
        tracked.append(odometry.process(replace(one, images=(image,))))
    x = np.array([t.T_odom_lidar[0, 3] for t in tracked])
    sigma = np.array([t.registration.worst_sigma for t in tracked])
    off = np.abs(np.diff(x) - 1.0)
    assert (off < 3 * np.hypot(sigma[:-1], sigma[1:])).all()
    assert off[2:].max() < 0.1  # once the motion is known
    assert [t.state for t in tracked[4:]] == [State.TRACKING] * 6


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.1, -0.1])
def test_a_picture_of_another_time_than_its_keyframe(late: float) -> None:
    """Its camera is placed where it was at the time of the image. Previously, places found with the image were off by
    the speed times the time difference."""
    paint, slam = random_paint(3), make_slam(GEOMETRIC)

    def place(i: float) -> float:
        return 0.03 * max(0.0, i - 3) ** 2  # at rest, then 6 m/s^2

    for i in range(14):
        image = replace(seen(place(i + 10 * late), paint, CAMERA), time_offset=late)
        slam.odometry.request_keyframe()
        result = slam.odometry_step(replace(frame(place(i), paint, i), images=(image,)))
    assert result.keyframe is not None
    picture = usable_image(result.keyframe.thumbnail)
    assert picture is not None
    ahead = place(13 + 10 * late) - place(13)
    # The speed is the average between this image and the previous one, 0.9 m/s off at most.
    np.testing.assert_allclose(picture.camera.T_lidar_cam[:3, 3], [ahead, 0, 0], atol=0.1)
    # The odometry follows the camera and is off by the same distance: correcting it with a speed from its images would
    # diverge.
    assert result.T_odom_lidar[0, 3] == pytest.approx(place(13) + ahead, abs=0.1)


@pytest.mark.slow
def test_an_image_that_is_sent_again_is_no_picture_of_a_keyframe() -> None:
    """Such an image shows another place."""
    frames = [noisy(frame(0.5 * i, random_paint(3), i)) for i in range(3)]
    for images, shown in ((frames[2].images, True), (frames[1].images, False)):
        slam = make_slam(GEOMETRIC)
        for one in frames[:2]:
            slam.odometry_step(one)
        slam.odometry.request_keyframe()
        keyframe = slam.odometry_step(replace(frames[2], images=images)).keyframe
        assert keyframe is not None
        assert (keyframe.thumbnail is not None) == shown


@pytest.mark.slow
def test_the_same_image_is_good_for_two_clouds_and_at_rest_without_noise() -> None:
    """The image is the nearest to both clouds, or the cloud is the same, too."""
    first, second = (frame(0.5 * i, random_paint(3), i) for i in range(2))
    late = replace(second, images=(replace(first.images[0], time_offset=-0.1),))
    for again in (late, replace(first, stamp=second.stamp)):
        odometry = make_odometry(GEOMETRIC)
        odometry.process(first)
        assert odometry.process(again).camera == ""


@pytest.mark.slow
def test_an_odometry_that_brakes_in_a_tunnel() -> None:
    """Six scans 1 m apart, then shorter and shorter steps. By its velocity alone it would overshoot, and be
    `degraded`."""
    paint = random_paint(3)
    steps = [1.0] * 5 + [0.7, 0.4, 0.1, 0.0]
    at = np.concatenate([[0.0], np.cumsum(steps)])
    frames = [noisy(frame(x, paint, i)) for i, x in enumerate(at)]
    odometry = {
        on: make_odometry(SlamSettings(registration="geometric", visual=VisualSettings(enabled=on)))
        for on in (True, False)
    }
    tracks = {on: [odometry[on].process(f) for f in frames] for on in odometry}
    errors = {
        on: [abs((se3.inverse(t[0].T_odom_lidar) @ t[i].T_odom_lidar)[0, 3] - at[i]) for i in range(len(at))]
        for on, t in tracks.items()
    }
    assert max(errors[True]) < 0.1
    assert errors[False][-1] > 1.0
    assert {str(t.state) for t in tracks[True][2:]} == {"tracking"}
    assert "degraded" in {str(t.state) for t in tracks[False]}


def test_points_images_and_intensities_of_a_real_drive_agree(kitti_root: Path) -> None:
    """Used where nothing is open, images and intensities move the result by centimeters: three measurements of one
    motion."""
    frames = list(open_source(kitti_root / "sequences" / "04").frames(0, 12))
    tracks = [track(frames, odometry={"degraded_sigma": sigma}) for sigma in (0.08, 1e-4)]
    methods = [tracked.registration.method for tracked in tracks[1][1:]]
    assert methods.count("visual") >= 4  # of 11: until there are enough scans to use the intensities
    assert methods.count("visual") + methods.count("intensity") >= 9
    assert "intensity" in methods
    assert {"visual", "intensity"}.isdisjoint(tracked.registration.method for tracked in tracks[0])
    steps = [[se3.inverse(a.T_odom_lidar) @ b.T_odom_lidar for a, b in pairwise(track)] for track in tracks]
    apart = [np.linalg.norm((se3.inverse(a) @ b)[:3, 3]) for a, b in zip(*steps, strict=True)]
    assert np.median(apart) < 0.03
