# SPDX-License-Identifier: Apache-2.0
"""A run from Python: its result, the files it saves, and that nothing is lost if it ends early."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.config import dump_settings, load_settings
from dpm2_core.data.open import open_source
from dpm2_core.data.ply import write_ply
from dpm2_core.data.trajectory import Trajectory, interpolate, read_trajectory, write_kitti, write_tum
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.report import metrics_table
from dpm2_core.evaluation.run_result import Result
from dpm2_core.frame import Frame
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.output import TrajectoryRecorder
from dpm2_core.slam.session import open_for_localization
from dpm2_core.slam.settings import Config
from dpm2_core.slam.store.map_data import load_map, trajectory
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.system import SlamResult

from ..helpers.drives import first_scans
from ..helpers.trajectories import write_indexed

FRAMES = 8
SET = ["slam.loops.enabled=false", "slam.threads=1"]
CONFIG = load_settings(Config, None, SET)
"""Without loops, which so short a drive does not have: no network is loaded."""
FILES = {
    "trajectory_kitti.txt", "trajectory.tum", "map.ply", "pose_graph.g2o", "timing.json", "metrics.json",
    "trajectory.png", "config.yaml", "frames.csv", "loops.csv", "ground_truth.tum",
}  # fmt: skip


@pytest.fixture(scope="module")
def recording(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first scans of the recording."""
    return first_scans(recording, FRAMES, tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def result(recording: Path) -> Result:
    """The result of the whole drive."""
    return OfflineRun(recording, CONFIG).run()


@pytest.mark.slow
def test_a_path_may_be_a_text(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Strings are accepted as paths, as in a notebook. Previously, `save` ended with an AttributeError after the
    drive."""
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(dump_settings(CONFIG))
    config = load_settings(Config, "mine.yaml")
    truth = str(next(recording.rglob("poses.txt")))
    with OfflineRun(str(recording), config, (0, 2), ground_truth=truth, map_file="drive.dpm2map") as drive:
        drive.run().save("out", cloud=False)
    assert Path("out/trajectory.tum").is_file()
    with pytest.raises(UsageError, match="no keyframe has descriptors"):
        open_for_localization("drive.dpm2map", config.slam)


@pytest.mark.slow
def test_it_is_the_slam_frame_by_frame(recording: Path, result: Result) -> None:
    """Reading ahead and recording do not change a bit of a pose."""
    slam = make_slam(CONFIG.slam)
    recorder = TrajectoryRecorder()
    for frame in open_source(recording).frames():
        recorder.add(slam.process(frame).odometry)
    assert len(result) == FRAMES
    assert result.recorder.stamps == recorder.stamps
    np.testing.assert_array_equal(result.poses, recorder.poses(slam.mapper.poses))
    assert result.registered == [True] * FRAMES
    assert dict(result.methods) == {"first": 1, "geometric": FRAMES - 1}
    assert result.metrics.ape_rmse_m < 0.03


@pytest.mark.slow
def test_a_stamp_that_is_off_is_corrected_whoever_reads_the_drive(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wrong stamps are corrected for any source, also where a drive begins or is resumed. Previously, in a user's own
    loader, a stamp 1 s ahead caused an error of 9 m without a message."""
    source = open_source(recording)
    scans = list(source.frames())
    wrong = scans[4].stamp + 10**9
    read = [*scans[:4], replace(scans[4], stamp=wrong), *scans[5:]]
    monkeypatch.setattr(source, "frames", lambda start=0, stop=None: iter(read[start:stop]))
    result = OfflineRun(source, CONFIG, (1, None)).run()
    np.testing.assert_allclose(result.recorder.stamps, [frame.stamp for frame in scans[1:]], atol=1000)
    what = "stamps that are not between their neighbors are interpolated"
    assert source.notes == [f"{what} (the first at frame 4: {wrong * 1e-9:.3f} s)"]
    config, path = load_settings(Config, None, [*SET, "slam.keyframes.distance=0"]), tmp_path / "drive.dpm2map"
    for span in ((0, 5), (0, 6)):  # the map ends with that frame, and resumes with it
        with OfflineRun(source, config, span, map_file=path, map_mode="resume") as drive:
            drive.run()
            assert drive.slam.mapper.keyframes[-1].index == span[1] - 1
    stamps = [keyframe.stamp for keyframe in drive.slam.mapper.keyframes]
    np.testing.assert_allclose(stamps, [scans[i].stamp for i in (0, 1, 2, 3, 4, 4, 5)], atol=1000)
    began = OfflineRun(source, CONFIG, (4, 5)).run().recorder.stamps
    np.testing.assert_allclose(began, [scans[4].stamp], atol=1000)


@pytest.mark.slow
def test_a_saved_result_is_every_file_and_reads_back(result: Result, tmp_path: Path) -> None:
    assert result.save(tmp_path / "new" / "out") == []
    out = tmp_path / "new" / "out"
    assert {path.name for path in out.iterdir()} == FILES
    assert load_settings(Config, out / "config.yaml", []) == CONFIG
    np.testing.assert_allclose(read_trajectory(out / "trajectory.tum").poses, result.poses, rtol=0, atol=1e-9)
    camera = read_trajectory(out / "trajectory_kitti.txt").poses
    np.testing.assert_allclose(camera, result.sensor_poses, rtol=0, atol=1e-9)  # as printed, with 13 digits
    assert json.loads((out / "metrics.json").read_text()) == json.loads(result.metrics.model_dump_json())
    timing = json.loads((out / "timing.json").read_text())
    assert list(timing) == ["frames", "fps", "wall_s", "answers", "states", "breaks", "stages_ms"]
    assert timing["frames"] == FRAMES
    assert timing["states"] == {"initialising": 1, "tracking": FRAMES - 1}
    assert timing["breaks"] == 0
    assert list(timing["stages_ms"])[-2:] == ["map", "total"]


@pytest.mark.slow
def test_an_interrupted_run_keeps_what_there_is(recording: Path, tmp_path: Path) -> None:
    seen: list[int] = []

    def progress(result: SlamResult) -> None:
        seen.append(result.odometry.index)
        if len(seen) == 4:
            raise KeyboardInterrupt  # as Ctrl-C does, here at a known frame

    result = OfflineRun(recording, CONFIG).run(progress)
    assert result.interrupted
    assert seen == [0, 1, 2, 3]
    result.save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    assert len(read_trajectory(tmp_path / "trajectory_kitti.txt")) == 4
    assert json.loads((tmp_path / "metrics.json").read_text())["frames"] == 4


@pytest.mark.slow
def test_interrupted_before_the_first_frame(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(recording)

    def frames(start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        raise KeyboardInterrupt

    monkeypatch.setattr(source, "frames", frames)
    result = OfflineRun(source, CONFIG).run()
    assert result.interrupted
    assert result.save(tmp_path) == ["no trajectory.png: no frame was processed"]
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"trajectory.png", "metrics.json", "ground_truth.tum"}


@pytest.mark.slow
def test_ground_truth_as_poses_and_as_a_tum_file(recording: Path, tmp_path: Path) -> None:
    """The same truth in either form gives nearly the same error: a TUM file is of the LiDAR, the other of the
    camera."""
    source = open_source(recording)
    assert source.poses is not None
    write_tum(tmp_path / "truth.tum", [frame.stamp for frame in source.frames()], source.poses)
    source.poses = None  # a recording without poses of its own
    alone = OfflineRun(source, CONFIG, (2, 7)).run()
    assert alone.metrics is None
    stamped = OfflineRun(source, CONFIG, (2, 7), tmp_path / "truth.tum").run()
    given = OfflineRun(source, CONFIG, (2, 7), recording / "poses" / "00.txt").run()
    assert stamped.metrics.truth == str(tmp_path / "truth.tum")
    assert given.metrics.frames == stamped.metrics.frames == 5  # of the drive, not of the whole truth
    assert stamped.metrics.path_length_m == pytest.approx(given.metrics.path_length_m, abs=0.1)
    assert (stamped.sensor, given.sensor) == ("LiDAR", "left camera")
    # They differ by the distance between the sensors times the rotation error.
    assert stamped.metrics.ape_rmse_m == pytest.approx(given.metrics.ape_rmse_m, abs=5e-3)
    stamped.save(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_truth_that_turns_out_not_to_fit_costs_nothing_else(recording: Path, result: Result, tmp_path: Path) -> None:
    """The results are complete, and results of a previous run do not remain."""
    stamps = result.recorder.stamps
    apart = Trajectory(np.tile(np.eye(4), (2, 1, 1)), np.array([stamps[0] - 10**9, stamps[-1] + 10**9]), "tum")
    result.save(tmp_path, cloud=False)
    (tmp_path / "timing.json").unlink()
    (tmp_path / "trajectory.png").unlink()
    with pytest.raises(UsageError, match="no pose during the ground truth"):
        replace(result, ground_truth=apart).save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"metrics.json", "ground_truth.tum"}


def test_a_drive_without_a_readable_scan_is_an_error(tmp_path: Path) -> None:
    """Previously, it ended with a trajectory of identities and exit code 0. A new map file is removed, so the next run
    can make it."""
    (tmp_path / "scans").mkdir()
    for n in range(3):
        (tmp_path / "scans" / f"{n}.ply").write_bytes(b"hello")
    words = r"scans: none of 3 scans could be read; the first: .*0.ply: no PLY"
    with (
        pytest.raises(Dpm2Error, match=words),
        OfflineRun(tmp_path / "scans", CONFIG, map_file=tmp_path / "drive.dpm2map") as drive,
    ):
        drive.run()
    assert [path.name for path in tmp_path.iterdir()] == ["scans"]
    write_ply(tmp_path / "scans" / "1.ply", np.ones((5, 4), np.float32))
    assert len(OfflineRun(tmp_path / "scans", CONFIG).run()) == 3


@pytest.mark.slow
def test_a_tum_file_of_another_clock_gives_the_figures_of_the_poses(recording: Path, tmp_path: Path) -> None:
    """A ground truth of 25 Hz, 12 ms late and longer than the drive, is interpolated. Previously, the nearest pose was
    0.1 m off, and most frames were left out."""
    source = open_source(recording)
    assert source.poses is not None
    stamps = np.array([frame.stamp for frame in source.frames()])
    at = np.arange(stamps[0] + 12_000_000, stamps[-1], 40_000_000)
    write_tum(tmp_path / "truth.tum", at.tolist(), interpolate(stamps, source.poses, at))
    source.T_cam_lidar = None  # the poses of the LiDAR in either case
    given = OfflineRun(source, CONFIG, (1, 6)).run().metrics
    stamped = OfflineRun(source, CONFIG, (1, 6), tmp_path / "truth.tum").run().metrics
    assert (stamped.frames, stamped.failed_frames) == (given.frames, 0)
    # Between two frames in a bend, the interpolated truth is off by a fraction of a millimeter.
    assert stamped.ape_rmse_m == pytest.approx(given.ape_rmse_m, abs=1e-3)
    assert stamped.rpe_trans_m == pytest.approx(given.rpe_trans_m, abs=2e-3)


def test_the_frames_of_a_drive_are_counted_whatever_its_truth_is_sampled_at(result: Result) -> None:
    """Failed frames are counted among all frames. Previously, with ground truth at 2 Hz, there were more of them than
    frames."""
    stamps = np.array(result.recorder.stamps)
    slower = replace(result, ground_truth=Trajectory(result.poses[::5], stamps[::5], "tum"))
    assert (slower.metrics.frames, slower.metrics.failed_frames) == (len(result), result.methods["failed"])


def test_of_how_many_poses_the_errors_are_is_said_where_not_of_all(result: Result) -> None:
    """Ground truth for the first five frames, as of cameras that see part of a hall, shows nothing about the rest."""
    stamps = np.array(result.recorder.stamps)
    part = replace(result, ground_truth=Trajectory(result.poses[:5], stamps[:5], "tum")).metrics
    whole = replace(result, ground_truth=Trajectory(result.poses, stamps, "tum")).metrics
    assert (part.compared, whole.compared) == (5, len(result))
    shown = [" ".join(metrics_table(of, "", "LiDAR").rows[0]) for of in (part, whole)]
    assert [text.endswith("5 poses compared") for text in shown] == [True, False]


def test_a_run_goes_on_in_its_map_file(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.dpm2map"
    with OfflineRun(recording, CONFIG, (0, 4), map_file=path) as begun:
        nodes = len(begun.run().mapper.keyframes)
    assert nodes >= 1
    with OfflineRun(recording, CONFIG, map_file=path, map_mode="resume") as again:
        result = again.run()
        assert result.mapper.session_start == nodes
        assert result.connected
        assert result.recorder.index[-1] == FRAMES - 1
        result.save(tmp_path / "out")
    with pytest.raises(UsageError, match="there is a file already"):
        OfflineRun(recording, CONFIG, map_file=path)


def test_the_frame_where_a_drive_goes_on_is_in_the_trajectory_of_its_map_once(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.dpm2map"
    for stop in (4, None):
        with OfflineRun(recording, CONFIG, (0, stop), map_file=path, map_mode="resume") as drive:
            drive.run()
    with MapStore.open(path) as store:
        data = load_map(store)
    stamps, poses = trajectory(data)
    assert stamps == sorted({keyframe.stamp for keyframe in data.keyframes})
    assert len(poses) == len(stamps) == len(data.keyframes) - 1


def test_a_run_is_over_once(recording: Path) -> None:
    """A second run is an error. Previously, it added the drive to the same map again, and the first result could not be
    saved, either."""
    drive = OfflineRun(recording, CONFIG, (0, 3))
    result = drive.run()
    with pytest.raises(UsageError, match="00: it was run already; a second run needs another OfflineRun"):
        drive.run()
    assert (len(result), result.metrics.frames) == (3, 3)


def test_a_drive_with_missing_scans_goes_on(recording: Path, tmp_path: Path) -> None:
    """Every second scan is missing: the frame where the map ends is found by its number, not by its position."""
    drive, path = tmp_path / "drive", tmp_path / "drive.dpm2map"
    first_scans(recording, FRAMES, drive)
    for scan in [*drive.rglob("velodyne/*.bin")]:
        if int(scan.stem) % 2:
            scan.unlink()
    with OfflineRun(drive, CONFIG, (0, 4), map_file=path) as begun:
        begun.run()
    with OfflineRun(drive, CONFIG, map_file=path, map_mode="resume") as again:
        assert again.run().recorder.index[-1] == FRAMES - 2


def test_another_drive_of_the_same_stamps_is_not_gone_on_with(recording: Path, tmp_path: Path) -> None:
    """This is an error. All synthetic drives have the same stamps: previously, another one was tied to the end of the
    map, to the millimeter."""
    path, other = tmp_path / "drive.dpm2map", tmp_path / "other"
    with OfflineRun(recording, CONFIG, (0, 4), map_file=path) as begun:
        begun.run()
    first_scans(recording, FRAMES, other)
    noise = np.random.default_rng(0)
    for scan in other.rglob("velodyne/*.bin"):
        scan.unlink()  # it may be a link
        noise.uniform((-40, -40, -2, 0), (40, 40, 6, 1), (2000, 4)).astype("<f4").tofile(scan)
    with (
        pytest.raises(UsageError, match=r"--resume: frame \d+ of \w+ is not the one with which the map ends"),
        OfflineRun(other, CONFIG, map_file=path, map_mode="resume") as again,
    ):
        again.run()


def test_a_run_that_localizes_has_no_poses_of_its_own(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.dpm2map"
    with OfflineRun(recording, Config(), (0, 8), map_file=path) as drive:
        drive.run()
    with (
        OfflineRun(recording, Config(), (0, 8), map_file=path, map_mode="localize") as drive,
        pytest.raises(UsageError, match="T_map_lidar of each result"),
    ):
        drive.run().save(tmp_path / "out")


def test_errors_of_use_come_before_anything_runs(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.dpm2map"
    with pytest.raises(UsageError, match="no such file"):
        OfflineRun(tmp_path / "nowhere", CONFIG, map_file=path)
    assert not [*tmp_path.iterdir()], "a map file that the corrected command would be refused for"
    with pytest.raises(UsageError, match=f"--frames 50:60: 00 has {FRAMES} frames"):
        OfflineRun(recording, CONFIG, (50, 60))
    write_kitti(tmp_path / "short.txt", np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(UsageError, match=f"3 poses for {FRAMES} frames of 00"):
        OfflineRun(recording, CONFIG, ground_truth=tmp_path / "short.txt")
    poses = np.tile(np.eye(4), (3, 1, 1))
    write_indexed(tmp_path / "other.txt", poses, [20, 21, 22])
    with pytest.raises(UsageError, match=f"other.txt: poses 20 to 22, but the frames of 00 are 2 to {FRAMES - 1}"):
        OfflineRun(recording, CONFIG, (2, None), tmp_path / "other.txt")
    write_tum(tmp_path / "late.tum", [10**15, 2 * 10**15, 3 * 10**15], poses)
    with pytest.raises(
        UsageError, match=r"late.tum: poses from 1000000.000 to 3000000.000 s, but the frames of 00 are"
    ):
        OfflineRun(recording, CONFIG, ground_truth=tmp_path / "late.tum")
