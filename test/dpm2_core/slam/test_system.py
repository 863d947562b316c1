# SPDX-License-Identifier: Apache-2.0
"""`Slam.process` is the whole algorithm: calling its two steps in turn gives the same result, and a frame passes few
modules."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import cast

import numpy as np
import pytest

from dpm2_core.data.thumbnail import image_of
from dpm2_core.estimates import Edge, Keyframe, Registration, State
from dpm2_core.frame import Array, Frame
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.build import make_odometry, make_slam
from dpm2_core.slam.loops.localizer import LocalizationResult
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSettings
from dpm2_core.slam.session import open_for_localization, open_session
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.slam.system import Slam

from ...helpers import corridor
from ...helpers.drives import InMemory
from ...helpers.scenes import make_image

GEOMETRIC = SlamSettings.model_validate({"registration": "geometric", "threads": 1, "loops": {"descriptors": False}})


@pytest.mark.slow
def test_the_steps_in_turn_are_the_whole(suburb_drive: tuple[list[Frame], Array]) -> None:
    """The ROS node runs the two steps in two threads: all poses and keyframes are the same."""
    frames = suburb_drive[0][:15]
    whole, steps = make_slam(GEOMETRIC), make_slam(GEOMETRIC)
    results = [whole.process(frame) for frame in frames]
    for frame, result in zip(frames, results, strict=True):
        odometry = steps.odometry_step(frame)
        if odometry.keyframe is not None:
            steps.map_step(odometry.keyframe)
        np.testing.assert_array_equal(odometry.T_odom_lidar, result.odometry.T_odom_lidar)
        assert (odometry.keyframe is None) == (result.map is None)
        assert result.state is odometry.state
    np.testing.assert_array_equal(whole.mapper.poses, steps.mapper.poses)
    assert len(whole.mapper.keyframes) > 1


def test_without_corrections_the_map_is_the_odometry(suburb_drive: tuple[list[Frame], Array]) -> None:
    slam = make_slam(GEOMETRIC)
    for frame in suburb_drive[0][:5]:
        result = slam.process(frame)
        assert result.T_map_lidar is not None
        np.testing.assert_allclose(result.T_map_lidar, result.odometry.T_odom_lidar, atol=1e-9)  # rounding


class _Loops:
    """Stand-in for the mapper. It reports a loop from node `since` to the last keyframe, or none."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self.since: int | None = None
        self.T_map_odom = np.eye(4)

    def add(self, keyframe: Keyframe) -> list[Edge]:
        self.keyframes.append(replace(keyframe, id=keyframe.id + 40))  # numbered after the keyframes of a loaded map
        if self.since is None:
            return []
        node = self.since if self.since >= 0 else len(self.keyframes) + self.since
        return [Edge("loop", node, len(self.keyframes) - 1, Registration(np.eye(4), np.eye(6)))]

    def kept(self, loops: list[Edge]) -> list[Edge]:
        return loops


@pytest.mark.parametrize(("since", "ends"), [(0, True), (-2, False), (None, False)])
def test_a_loop_across_a_break_ends_the_doubt_of_it(
    suburb_drive: tuple[list[Frame], Array], since: int | None, ends: bool
) -> None:
    """After a pause, this needs a loop to a keyframe before the pause, not to a later one. Previously, the state was
    `degraded` for the rest of the drive."""
    frames = [replace(frame, stamp=frame.stamp + 60 * 10**9 * (n >= 6)) for n, frame in enumerate(suburb_drive[0])]
    elsewhere = np.array([1, -1, 1, 1], np.float32)
    frames[6:] = [replace(frame, points=frame.points * elsewhere) for frame in frames[6:]]
    settings = GEOMETRIC.model_copy(update={"keyframes": KeyframeSettings(distance=1.0)})
    loops = _Loops()
    slam = Slam(make_odometry(settings), cast(Mapper, loops))
    states = []
    for frame in frames:
        result = slam.process(frame)
        states.append(result.state)
        if result.odometry.breaks and result.map is not None and loops.since is None:
            loops.since = since  # for the next keyframe
    assert State.LOST in states
    assert states[-1] is (State.TRACKING if ends else State.DEGRADED)
    assert result.odometry.breaks == int(not ends)


@pytest.mark.weights
@pytest.mark.parametrize(("registration", "most"), [("geometric", 10), ("adaptive", 11)])
def test_a_frame_passes_few_modules(suburb_drive: tuple[list[Frame], Array], registration: str, most: int) -> None:
    """A frame passes few modules between the recording and the recorded pose. Functions of `geometry` and modules of
    data types do not count.

    One module chooses the odometry, for streets or for rooms. The default has one module more than point-to-plane
    registration alone: it decides whether the network runs. A frame that is kept passes it, too: its intensities are
    stored for a scan that will need them.
    """
    names: dict[str, None] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        name = frame.f_globals.get("__name__", "")
        if event == "call" and name.startswith("dpm2_core.slam."):
            names[name] = None

    def between(number: int) -> None:
        sys.setprofile(note if number == 7 else None)  # the ninth frame: the drive is under way

    numbers = iter(range(len(suburb_drive[0])))
    config = Config(slam=GEOMETRIC.model_copy(update={"registration": registration}))
    try:
        with OfflineRun(InMemory(suburb_drive[0][:12]), config) as drive:
            drive.run(lambda result: between(next(numbers)))
    finally:
        sys.setprofile(None)
    nouns = {"dpm2_core.slam.output", "dpm2_core.slam.registration.protocol", "dpm2_core.slam.odometry.motion_state"}
    names = names.keys() - nouns
    assert "dpm2_core.slam.registration.icp" in names
    assert len(names) <= most, "\n".join(names)


@pytest.mark.weights
@pytest.mark.slow
def test_in_a_map_that_stays_the_place_is_known_when_it_is_found(
    suburb_drive: tuple[list[Frame], Array], tmp_path: Path
) -> None:
    """First, scans from elsewhere: `T_map_lidar` is None and keyframes are requested. Then the mapped street, which the
    network recognizes. Registration is geometric: for one random scan after the other the network would only take
    time."""
    frames, truth = suburb_drive
    settings = SlamSettings(registration="geometric", threads=1)
    path = tmp_path / "street.dpm2map"
    with open_session(path, settings, "", resume=False) as store:
        slam = make_slam(settings, store=store)
        for frame in frames[:25]:
            slam.process(frame)
        slam.finish()
    rng = np.random.default_rng(0)
    nowhere = rng.uniform(-20, 20, (5000, 4)).astype(np.float32)
    with open_for_localization(path, settings) as store:
        slam = make_slam(settings, store=store)
        results = [slam.process(Frame(n * 10**8, nowhere, index=n)) for n in range(21)]
        assert all(result.T_map_lidar is None for result in results)
        assert all(result.state in (State.INITIALIZING, State.RELOCALIZING) for result in results)
        tried = [n for n, result in enumerate(results) if result.map is not None]
        assert tried == [0, 10, 20]  # once per second, at standstill
        slam.odometry.reset()
        found = slam.process(Frame(21 * 10**8 + 9 * 10**8, frames[10].points))
        assert isinstance(found.map and found.map.located, LocalizationResult)
        assert found.T_map_lidar is not None
        assert np.linalg.norm(found.T_map_lidar[:3, 3] - truth[10, :3, 3]) < 0.1
        assert slam.mapper.loops == []


def test_a_keyframe_carries_its_thumbnail_into_the_map_file(
    suburb_drive: tuple[list[Frame], Array], noise: np.random.Generator, tmp_path: Path
) -> None:
    settings = GEOMETRIC.model_copy(update={"map": GEOMETRIC.map.model_copy(update={"thumbnail": 32})})
    image = make_image(noise)
    with open_session(tmp_path / "a.dpm2map", settings, "", resume=False) as store:
        slam = make_slam(settings, store=store)
        assert slam.uses_images
        slam.process(Frame(0, suburb_drive[0][0].points, images=(image,)))
        slam.finish()
        jpeg = store.payload(0, "thumbnail")
    assert jpeg is not None
    assert jpeg.startswith(b"\xff\xd8")
    assert slam.mapper.keyframes[0].thumbnail is None  # in the file, not in memory


@pytest.mark.long
@pytest.mark.weights
def test_in_a_corridor_keyframes_keep_a_picture_by_which_the_robot_finds_itself(tmp_path: Path) -> None:
    """End to end: images with the scans, a map file, and a later drive that begins somewhere along the corridor."""
    paint, settings = corridor.random_paint(3), SlamSettings(threads=1)
    path = tmp_path / "corridor.dpm2map"
    with open_session(path, settings, "", resume=False) as store:
        slam = make_slam(settings, store=store)
        for n in range(26):
            slam.process(corridor.frame(1.0 * n, paint, n))
        slam.finish()
        pictured = [store.payload(node, "thumbnail") is not None for node in range(len(slam.mapper.keyframes))]
    assert len(pictured) >= 5
    assert all(pictured)
    with open_for_localization(path, settings) as store:
        slam = make_slam(settings, store=store)
        located = [slam.process(corridor.frame(11.7 + 0.8 * n, paint, 500 + n, gain=0.7)).T_map_lidar for n in range(8)]
    assert located[0] is not None
    assert located[0][0, 3] == pytest.approx(11.7, abs=0.1)
    assert located[-1] is not None
    assert located[-1][0, 3] == pytest.approx(11.7 + 0.8 * 7, abs=0.1)


@pytest.mark.parametrize("hangs", ["front", "rear"])
def test_a_camera_that_hangs_costs_the_picture_of_no_other_one(hangs: str, tmp_path: Path) -> None:
    """Each keyframe along a corridor has an image, from the first camera that shows something new."""
    paint = corridor.random_paint(3)
    still = corridor.frame(0.0, paint).images[0]

    def frame_with_both(n: int) -> Frame:
        seen = corridor.frame(1.0 * n, paint, n)
        images = [
            replace(still if name == hangs else seen.images[0], camera=replace(still.camera, name=name))
            for name in ("front", "rear")
        ]
        return replace(seen, images=tuple(images))

    with open_session(tmp_path / "a.dpm2map", GEOMETRIC, "", resume=False) as store:
        slam = make_slam(GEOMETRIC, store=store)
        results = [slam.process(frame_with_both(n)).odometry for n in range(8)]
        slam.finish()
        pictures = [image_of(store.payload(node, "thumbnail") or b"") for node in range(len(slam.mapper.keyframes))]
    assert all(result.camera for result in results[1:])
    assert len(pictures) >= 2
    works = "rear" if hangs == "front" else "front"
    assert [picture and picture.camera.name for picture in pictures[1:]] == [works] * (len(pictures) - 1)


def test_in_a_street_keyframes_keep_no_picture(
    suburb_drive: tuple[list[Frame], Array], noise: np.random.Generator, tmp_path: Path
) -> None:
    """Except the first one, because nothing is known about the environment yet. So a map stays small."""
    image = make_image(noise)
    with open_session(tmp_path / "a.dpm2map", GEOMETRIC, "", resume=False) as store:
        slam = make_slam(GEOMETRIC, store=store)
        for f in suburb_drive[0][:15]:
            slam.process(replace(f, images=(image,)))
        slam.finish()
        pictured = [store.payload(node, "thumbnail") is not None for node in range(len(slam.mapper.keyframes))]
    assert len(pictured) >= 2
    assert pictured == [True] + [False] * (len(pictured) - 1)
