# SPDX-License-Identifier: Apache-2.0
"""A second LiDAR and a second camera in a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.data.bags import BagSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from test.helpers.recordings import IMAGE, INFO, POINTS, Message, by_time, clouds, rig, seen

# --- a second LiDAR


def test_clouds_of_a_second_lidar_join_in_the_frame_of_the_first(bags: Any, tmp_path: Path) -> None:
    """It is mounted 2 m to the left, and its clouds are 40 ms later: their points have this time."""
    second = [(t + 0.04, "/second", bags.cloud(t + 0.04, x=10 * t, frame="left")) for t in (1, 1.1, 1.3)]
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", by_time([*clouds(bags, [1, 1.1, 1.2, 1.3]), *second, tree]))
    settings = InputSettings(points_topic=POINTS, second_points_topic="/second")
    frames = list(BagSource(bag, settings).frames())
    assert [len(frame.points) for frame in frames] == [120, 120, 60, 120]
    for n, frame in enumerate(frames):
        np.testing.assert_allclose(frame.points[:60], [[n, 2, 3, 0.5]] * 60, rtol=1e-6)
    np.testing.assert_allclose(frames[1].points[60:], [[11, 4, 3, 0.5]] * 60, rtol=1e-6)
    assert frames[1].time_offset is not None
    np.testing.assert_allclose(frames[1].time_offset, [0.0] * 60 + [0.04] * 60, atol=1e-6)
    assert frames[2].time_offset is None


def test_missing_returns_of_a_second_lidar_are_no_points_at_its_place(bags: Any, tmp_path: Path) -> None:
    """Drivers send zeros for them, or NaN. Their times are removed, too."""
    columns = {name: np.full(60, value, np.float32) for name, value in (("x", 5.0), ("y", 2.0), ("z", 3.0))}
    columns["t"] = np.linspace(0, 0.1, 60, dtype=np.float32)
    for name in "xyz":
        columns[name][:20], columns[name][20:30] = 0, np.nan
    second = bags.cloud_of(1, columns, "left")
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", [*clouds(bags, [1]), (1, "/second", second), tree])
    (frame,) = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second")).frames()
    np.testing.assert_allclose(frame.points[60:], [[5, 4, 3, 0]] * 30, rtol=1e-6)
    assert frame.time_offset is not None
    np.testing.assert_allclose(frame.time_offset, [*[0] * 60, *columns["t"][30:]], atol=1e-6)  # float32 of 0.1 s


def test_a_sweep_of_a_second_lidar_is_in_one_part_of_a_sweep_of_the_first(bags: Any, tmp_path: Path) -> None:
    """In the nearest one. It was in all ten, so that each spanned a sweep, none was joined, and each was registered by
    points that were nine tenths the same as before: 0.9 m off in 30 m, and ten times the work."""
    times = np.arange(10, 12, 0.01).round(2)
    second = [(t + 0.1, "/second", bags.cloud(t, x=100.0, frame="left")) for t in np.arange(10.003, 12, 0.1)]
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", by_time([tree, *[(t + 0.01, POINTS, bags.cloud(t)) for t in times], *second]))
    source = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second"))
    both = [frame.index for frame in source.frames() if len(frame.points) > 60]
    assert both == list(range(0, 200, 10))


@pytest.mark.parametrize(("ahead", "missing"), [(0, 0), (0.08, 4), (1000, 4)])
def test_clouds_of_a_second_lidar_that_do_not_fit_are_counted(
    bags: Any, tmp_path: Path, ahead: float, missing: int
) -> None:
    """Too far apart, or with stamps of another clock: as for a camera, nothing else reports that its points are
    missing."""
    times = [1, 1.2, 1.4, 1.6]
    second = [(t + 0.01, "/second", bags.cloud(t + ahead, frame="left")) for t in times]
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", by_time([tree, *clouds(bags, times), *second]))
    source = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second"))
    assert [len(frame.points) for frame in source.frames()] == [60 if missing else 120] * 4
    said = [note for note in source.notes if "/second" in note]
    assert said == ["4 of 4 frames have no cloud of /second (within 0.05 s)"] * bool(missing)


@pytest.mark.parametrize(("clock", "later"), [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.7, 0.0), (0.0, 0.1)])
def test_a_second_lidar_with_another_clock_is_named(bags: Any, tmp_path: Path, clock: float, later: float) -> None:
    """Its clock differs by some periods, so its clouds are joined with others than those measured at the same time. A
    difference of one sweep between the recording times does not show another clock: one driver may stamp the start, the
    other one the end."""
    times = np.arange(10, 13, 0.1).round(1)
    second = [(t + 0.05 + later, "/second", bags.cloud(t + clock, frame="left")) for t in times]
    first = [(t + 0.05, POINTS, bags.cloud(t)) for t in times]
    tree = (1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0)))
    bag = bags.write(tmp_path / "b", by_time([tree, *first, *second]))
    source = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second"))
    assert [len(frame.points) for frame in source.frames()].count(120) >= 20
    said = [note for note in source.notes if "later after its stamps" in note]
    assert [note[:31] for note in said] == [f"/second: recorded {-clock:+.2f} s later"] * (clock != 0)


def test_a_second_lidar_in_the_frame_of_the_first_needs_no_transform(bags: Any, tmp_path: Path) -> None:
    second = (1, "/second", bags.cloud(1, x=7, frame="/velo_link"))
    bag = bags.write(tmp_path / "b", [*clouds(bags, [1]), second])
    (frame,) = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second")).frames()
    np.testing.assert_array_equal(frame.points[60:, 0], [7] * 60)


def test_a_second_lidar_without_a_place_is_left_out(bags: Any, tmp_path: Path) -> None:
    second = [(1.01, "/second", bags.cloud(1.01, frame="left"))]
    bag = bags.write(tmp_path / "b", [*clouds(bags, [1]), *second])
    source = BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic="/second"))
    assert [len(frame.points) for frame in source.frames()] == [60]
    assert "/second: no transform from 'left' to 'velo_link'" in source.notes[0]
    assert "going on without the second LiDAR" in source.notes[0]
    for wrong in ("/third", POINTS):
        with pytest.raises(UsageError, match=rf"second_points_topic: no other point clouds on {wrong}; topics: "):
            BagSource(bag, InputSettings(points_topic=POINTS, second_points_topic=wrong))


def test_two_lidars_on_one_topic_are_not_taken_for_one_that_jumps(bags: Any, tmp_path: Path) -> None:
    """They are rejected, as in slam_node: what the second LiDAR sees is no motion of the first. A frame's name has a
    slash in ROS 1 and none in ROS 2."""
    frames = ["velo_link", "left", "/velo_link", "left"]
    sent = [(t, POINTS, bags.cloud(t, frame=frame)) for t, frame in zip((1, 1.1, 1.2, 1.3), frames, strict=True)]
    bag = bags.write(tmp_path / "b", [(1, "/tf_static", bags.transform("velo_link", "left", (0, 2, 0))), *sent])
    source = BagSource(bag)
    read = list(source.frames())
    problem = "a cloud in frame 'left', the drive's are in 'velo_link': one drive has one LiDAR"
    assert [frame.problem for frame in read] == [None, problem, None, problem]
    assert [len(frame.points) for frame in read] == [60, 0, 60, 0]
    assert f"{POINTS}: {problem}" in source.notes


# --- a second camera


def test_two_cameras_on_one_topic_are_not_taken_for_one_that_jumps(bags: Any, tmp_path: Path) -> None:
    """For example of drivers in namespaces that are remapped to one topic. The other camera's images are nearer to the
    clouds, and its calibration arrives first. The camera whose image arrives first is used, with its own
    calibration."""
    sent = [(0.9, INFO, bags.info(0.9)), *clouds(bags, [1, 1.1, 1.2])]
    sent[0][2].header.frame_id, sent[0][2].width = "left", 4
    for n, t in enumerate((1, 1.1, 1.2)):
        first, second = bags.image(t + 0.01, value=n), bags.image(t, value=9)
        second.header.frame_id = "left"
        sent += [(t - 0.02, IMAGE, first), (t - 0.01, IMAGE, second)]
    place = (1, "/tf_static", bags.transform("velo_link", "left", (0, 1, 0)))
    source = BagSource(bags.write(tmp_path / "b", by_time([*rig(bags), place, *sent])))
    for _ in range(2):  # read again
        assert seen(source) == [0, 1, 2]
    problem = "a message in frame 'left', the previous ones are in 'cam': a topic has one sensor"
    assert f"{IMAGE}: 3 samples left out (the first: {problem})" in source.notes


REAR, REAR_INFO = "/rear/image_raw", "/rear/camera_info"


def of_frame(message: Any, frame: str) -> Any:
    message.header.frame_id = frame
    return message


def rear(bags: Any, times: list[float]) -> list[Message]:
    """A camera 1 m behind the LiDAR, with gray values of 100 and more."""
    images = [(t, REAR, of_frame(bags.image(t, 100 + n), "rear")) for n, t in enumerate(times)]
    info, place = of_frame(bags.info(1), "rear"), bags.transform("velo_link", "rear", (-1, 0, 0))
    return [(1, REAR_INFO, info), (1, "/tf_static", place), *images]


def all_seen(source: BagSource) -> list[list[int]]:
    """Gray values of each frame's images."""
    return [[int(image.pixels[0, 0, 0]) for image in frame.images] for frame in source.frames()]


TWO = InputSettings(second_image_topic=REAR)


def test_images_of_two_cameras_each_join_the_nearest_cloud(bags: Any, tmp_path: Path) -> None:
    """The cameras are out of phase. Each misses some clouds, which does not affect the other. The second camera alone
    is an ordinary camera."""
    times = [1.0, 1.1, 1.2, 1.3, 1.4]
    ahead = [(t, IMAGE, bags.image(t, n)) for n, t in enumerate((1.01, 1.11, 1.41))]
    recorded = [*clouds(bags, times), *rig(bags), *ahead, *rear(bags, [0.97, 1.17, 1.27, 1.37])]
    bag = bags.write(tmp_path / "b", by_time(recorded))
    source = BagSource(bag, TWO)
    frames = list(source.frames())
    assert all_seen(source) == [[0, 100], [1], [101], [102], [2, 103]]
    assert [image.camera.T_lidar_cam[0, 3] for image in frames[0].images] == [0.2, -1]
    assert [image.camera.name for image in frames[0].images] == [IMAGE, REAR]
    assert source.camera.T_lidar_cam[0, 3] == 0.2
    assert f"2 of 5 frames have no image of {IMAGE} (within 0.05 s)" in source.notes
    assert f"1 of 5 frames have no image of {REAR} (within 0.05 s)" in source.notes
    assert all_seen(BagSource(bag, InputSettings(image_topic=IMAGE))) == [[0], [1], [], [], [2]]
    assert all_seen(BagSource(bag, InputSettings(image_topic=REAR))) == [[100], [], [101], [102], [103]]
    placed = InputSettings(second_image_topic=REAR, T_lidar_cam=(0.5, 0, 0, 0, 0, 0, 1))  # only of the first one
    (first, *_) = BagSource(bag, placed).frames()
    assert [image.camera.T_lidar_cam[0, 3] for image in first.images] == [0.5, -1]
    alone = bags.write(tmp_path / "alone", by_time([*clouds(bags, times), *rear(bags, times)]))
    assert all_seen(BagSource(alone, TWO)) == [[100 + n] for n in range(5)]


def test_a_second_camera_that_cannot_be_used_is_named(bags: Any, tmp_path: Path) -> None:
    """It was requested, so this is an error, as for any requested camera. Images that cannot be read cost only
    themselves."""
    first = [*clouds(bags, [1, 2]), *rig(bags), (1, IMAGE, bags.image(1, 7)), (2, IMAGE, bags.image(2, 8))]
    second = rear(bags, [1, 2])
    cases: list[tuple[list[Message], str]] = [
        ([], f"input.second_image_topic: no other images on {REAR}; topics: "),
        (second[1:], f"no CameraInfo on {REAR_INFO} for {REAR}"),
        ([second[0], *second[2:]], f"camera {REAR}: no transform from 'rear' to 'velo_link'; .*; publish it on /tf_st"),
        (
            [(1, REAR_INFO, bags.info(1)), *second[1:]],
            f"camera {REAR}: its frame 'cam' is that of {IMAGE}: two cameras",
        ),
    ]
    for n, (messages, problem) in enumerate(cases):
        bag = bags.write(tmp_path / str(n), by_time([*first, *messages]))
        with pytest.raises(UsageError, match=problem):
            BagSource(bag, TWO)
        assert len(BagSource(bag, InputSettings(image_topic=IMAGE))) == 2
    with pytest.raises(UsageError, match=rf"second_image_topic: no other images on {IMAGE}"):
        BagSource(tmp_path / "0", InputSettings(image_topic=IMAGE, second_image_topic=IMAGE))
    assert all_seen(BagSource(tmp_path / "0", InputSettings(images=False, second_image_topic=REAR))) == [[], []]
    odd = of_frame(bags.image(1, 9, encoding="yuv411"), "rear")
    source = BagSource(bags.write(tmp_path / "odd", by_time([*first, *second[:2], (1, REAR, odd), second[3]])), TWO)
    assert all_seen(source) == [[7], [8, 101]]
    assert any(note.startswith(f"{REAR}: image encoding 'yuv411' is not supported") for note in source.notes)
