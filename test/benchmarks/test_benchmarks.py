# SPDX-License-Identifier: Apache-2.0
"""The benchmark harness runs each method on the same drive, and its record states how it was made."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from benchmarks import BENCHES
from benchmarks.geometric import kiss_icp
from benchmarks.harness import Options, drives, processors
from benchmarks.memory import levelling
from benchmarks.pairs import FITTED, fitted_poses, pairs_of, summarized
from dpm2_core.commands.bench import bench
from dpm2_core.data.open import open_source
from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.data.trajectory import write_kitti
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.experiments.peers import KissIcp, at_stamps, end_of
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.weights import save_weights
from dpm2_core.slam.build import make_registration
from dpm2_core.slam.settings import SlamSettings

from ..helpers.scenes import boxes, make_image

FRAMES = 6


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A KITTI sequence of a street with houses, 1 m per frame, as points with 1 cm of noise."""
    folder = tmp_path_factory.mktemp("street")
    (folder / "velodyne").mkdir()
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    (folder / "dpm2_sim.json").write_text('{"vertical_angle_correction_deg": 0}')
    rng = np.random.default_rng(0)
    ground = rng.uniform([-40, -8, -1.7], [50, 8, -1.7], (12_000, 3))
    walls = rng.uniform([-40, -1, -1.7], [50, 1, 5], (24_000, 3))
    walls[:, 1] = np.where(walls[:, 1] < 0, -8, 8) + 2 * (np.floor(walls[:, 0] / 7) % 2)  # set back every other house
    world = np.vstack([ground, walls])
    T_world_lidar = se3.exp(np.outer(np.arange(FRAMES), [0, 0, 0.01, 1, 0, 0]))
    for i, T in enumerate(T_world_lidar):
        points = se3.transform(se3.inverse(T), world + rng.normal(scale=0.01, size=world.shape))
        scan = np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4")
        scan.tofile(folder / "velodyne" / f"{i:06d}.bin")
    T_cam_lidar = se3.make([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0, 0, 0])
    write_kitti(folder / "poses.txt", T_cam_lidar @ T_world_lidar @ se3.inverse(T_cam_lidar))
    return folder


@pytest.mark.slow
def test_poses_that_err_are_fitted_to_the_scans_and_those_that_are_far_off_stay(sequence: Path) -> None:
    """1.5 degrees and 0.1 m, as KITTI's over a corner, are corrected to the effect of 1 cm noise; 20 m off is kept."""
    source = open_source(sequence)
    frames, poses = list(source.frames()), np.array(source.poses)
    wrong = poses.copy()
    wrong[2] = poses[2] @ se3.exp([0, 0, np.radians(1.5), 0.1, 0, 0])
    wrong[4] = poses[4] @ se3.exp([0, 0, np.radians(90), 20, 0, 0])
    pairs = [(0, 1), (0, 2), (0, 4)]
    points = make_registration(SlamSettings(registration="geometric"))
    right, fitted, left = fitted_poses(points, frames, pairs, wrong)
    for (a, b), T in zip(pairs[:2], (right, fitted), strict=True):
        m, deg = se3.apart(se3.inverse(poses[a]) @ poses[b], T)
        assert m < 0.05
        assert deg < 0.1
    np.testing.assert_array_equal(left, se3.inverse(wrong[0]) @ wrong[4])


@pytest.mark.slow
def test_the_help_names_every_benchmark() -> None:
    """`--help` imports none of them."""
    (argument,) = get_type_hints(bench, include_extras=True)["names"].__metadata__
    names = argument.help.removeprefix("Benchmarks to run: ").removesuffix(".").replace(" (default)", "")
    assert names.split(", ") == list(BENCHES)


def test_the_geometric_benchmark_records_errors_speed_and_origin(sequence: Path, tmp_path: Path) -> None:
    bench(
        ["geometric"],
        source=[sequence, sequence],
        out=tmp_path,
        repetitions=2,
        threads=1,
        settings=["slam.registration=geometric"],
    )
    record = json.loads((tmp_path / "geometric.json").read_text())
    assert (record["benchmark"], record["overrides"]) == ("geometric", ["slam.registration=geometric"])
    assert record["machine"]["threads"] == 1
    assert record["versions"]["numpy"] == np.__version__
    assert set(record["drives"]) == {sequence.name, f"{sequence.name} (2)"}
    ours = record["drives"][sequence.name]["dpm2"]
    assert (ours["frames"], ours["failed_frames"]) == (FRAMES, 0)
    assert ours["rpe_trans_m"] < 0.02  # noise of 1 cm per point, thousands of points
    assert len(ours["fps_of_repetitions"]) == 2
    assert ours["frame_ms"]["p95"] >= ours["frame_ms"]["median"] > 0
    assert set(ours["stages_ms"]) == {"preprocess", "register", "update", "map"}


@pytest.mark.slow
def test_kiss_icp_runs_beside_it_on_the_same_scans(sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("kiss_icp")
    bench(None, source=[sequence], out=tmp_path, repetitions=1, threads=2)
    record = json.loads((tmp_path / "geometric.json").read_text())
    assert record["truth"] == {sequence.name: f"{sequence.name}/poses.txt"}
    methods = record["drives"][sequence.name]
    assert methods["kiss-icp"]["rpe_trans_m"] < 0.02
    ratio = methods["ratio"]
    assert ratio["fps"] == pytest.approx(methods["dpm2"]["fps"] / methods["kiss-icp"]["fps"], rel=0.01)
    assert ratio["ape_rmse_m"] == pytest.approx(methods["dpm2"]["ape_rmse_m"] / methods["kiss-icp"]["ape_rmse_m"])


def test_kiss_icp_deskews_scans_whose_points_have_times_as_ours_does() -> None:
    """Its pipeline does so; its poses are then compared at the stamps. Otherwise raw sweeps of a bag are a
    disadvantage."""
    pytest.importorskip("kiss_icp")
    world = np.random.default_rng(0).uniform(-30, 30, (4000, 3))
    offset = np.linspace(-0.05, 0.05, len(world))

    def swept(t: float) -> Frame:
        T = se3.exp(np.outer(t + offset, [0, 0, -0.3, -8, 0, 0]))  # T_lidar_world when each point is measured
        points = (T[:, :3, :3] @ world[..., None])[..., 0] + T[:, :3, 3]
        cloud = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
        return Frame(round(t * 1e9), cloud, offset.astype(np.float32))

    frames = [swept(0.1 * number) for number in range(4)]
    deskewing, as_given = KissIcp(1, deskew=True), KissIcp(1, deskew=False)
    for frame in frames:
        deskewing.add(frame)
        as_given.add(frame)
    ends, stamps = [end_of(frame) for frame in frames], [frame.stamp for frame in frames]
    assert kiss_icp(Options(threads=1))(frames).poses == pytest.approx(
        at_stamps(deskewing.poses(), ends, stamps), abs=1e-9
    )
    known = Options(threads=1, overrides=("slam.preprocess.deskew=false",))
    assert kiss_icp(known)(frames).poses == pytest.approx(as_given.poses(), abs=1e-9)
    without = [replace(frame, time_offset=None) for frame in frames]
    assert kiss_icp(Options(threads=1))(without).poses == pytest.approx(as_given.poses(), abs=1e-9)


@pytest.mark.slow
def test_frames_farther_apart_are_measured_as_far_as_a_drive_has_them(sequence: Path, tmp_path: Path) -> None:
    bench(["hard"], source=[sequence], out=tmp_path, threads=1, only="geometric")
    rates = json.loads((tmp_path / "hard.json").read_text())["drives"][sequence.name]
    assert [(rate, row["geometric"]["frames"]) for rate, row in rates.items()] == [("every 1", 6), ("every 3", 2)]
    assert rates["every 1"]["geometric"]["rpe_trans_m"] < 0.02
    assert rates["every 1"]["geometric"]["failed_frames"] == 0
    assert rates["every 1"]["geometric"]["verdict"] == "right"
    assert (tmp_path / "hard.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.weights
@pytest.mark.slow
def test_the_covariance_benchmark_has_a_ratio_for_each_method_and_kind_of_pair(sequence: Path, tmp_path: Path) -> None:
    bench(["covariance"], source=[sequence], out=tmp_path, threads=1, only="real")
    kinds = json.loads((tmp_path / "covariance.json").read_text())["real"][sequence.name]
    assert set(kinds) == {"consecutive", "8 apart", "10-20 m", "20-30 m", "30-40 m", "40-50 m"}
    near = kinds["consecutive"]
    assert near["geometric"]["registered"] == near["geometric"]["pairs"] == FRAMES - 1
    assert 0 < near["geometric"]["chi2_ratio"]["pose"] < 4  # noise without calibration errors
    assert kinds["8 apart"]["neural"] == {
        "pairs": 0,
        **dict.fromkeys(("median_m", "median_deg", "chi2_ratio")),
        "registered": 0,
    }


@pytest.mark.long
@pytest.mark.weights
def test_the_tilt_benchmark_compares_level_axes_with_those_of_the_sensor(sequence: Path, tmp_path: Path) -> None:
    bench(["tilt"], source=[sequence], out=tmp_path, threads=1, pairs=1)
    tilts = json.loads((tmp_path / "tilt.json").read_text())["drives"][sequence.name]
    assert set(tilts) == {"0", "15", "30", "random"}
    level, sensor = (tilts["0"]["opposite"][axes] for axes in ("level", "sensor"))
    assert level == sensor  # for a level sensor both are the same
    assert level["1 apart"]["pairs"] == 1
    assert level["8 apart"]["pairs"] == 0  # the drive is shorter


@pytest.mark.slow
def test_the_memory_benchmark_samples_the_resident_set(sequence: Path, tmp_path: Path) -> None:
    bench(["memory"], source=[sequence], out=tmp_path)
    result = json.loads((tmp_path / "memory.json").read_text())["drives"][sequence.name]
    assert result["samples"][0][0] == 0
    assert result["rss_mb"]["start"] > 20, "an interpreter with numpy alone takes more"
    assert result["keyframes"] >= 1


def test_memory_that_grows_and_memory_that_levels_off_are_told_apart() -> None:
    frames = range(0, 2001, 50)
    grows = levelling([(n, 100 + 0.1 * n) for n in frames])
    level = levelling([(n, 100 + min(0.1 * n, 80)) for n in frames])
    assert grows["growth_mb_per_1000_frames_second_half"] == pytest.approx(100)
    assert level["growth_mb_per_1000_frames_second_half"] == pytest.approx(0, abs=1e-9)
    assert level["rss_mb"] == {"start": 100, "half": 180, "end": 180}
    assert levelling([(0, 100.0)])["growth_mb_per_1000_frames_second_half"] is None


@pytest.mark.slow
def test_the_resident_set_follows_what_is_allocated() -> None:
    """In a separate process: memory of other tests is freed at any time, by garbage collection or a thread."""
    program = (
        "import numpy as np\n"
        "from benchmarks.resident import resident_mb\n"
        "before = resident_mb()\n"
        "block = np.ones(2**23)\n"
        "print(resident_mb() - before)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(64, abs=2)  # the block and a few pages; the interpreter allocates little


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux binds a process to processors")
def test_processors_are_limited_inside_the_block_alone() -> None:
    before = os.sched_getaffinity(0)
    with processors(1):
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_drives_are_read_as_the_settings_say(sequence: Path) -> None:
    options = Options(sources=[sequence], overrides=["input.vertical_angle_correction_deg=0.3"])
    with drives(options) as sources:
        assert [source.vertical_angle_correction_deg for source in sources.values()] == [0.3]  # the recording has 0


def test_a_packed_excerpt_is_unpacked_for_as_long_as_the_run_lasts(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DPM2_KITTI", str(tmp_path))
    unpack = tmp_path / "unpack.py"
    unpack.write_text(f"import shutil, sys\nshutil.copytree({str(sequence)!r}, sys.argv[1] + '/sequences/07')")
    with drives(Options()) as sources:
        assert [(name, len(source)) for name, source in sources.items()] == [("07", FRAMES)]
        frame = next(iter(sources["07"].frames(0, 1)))
    assert len(frame.points) == 36_000
    unpack.write_text("raise SystemExit('scan 3 is damaged')")
    with pytest.raises(Dpm2Error, match=r"unpack\.py: .*scan 3 is damaged"), drives(Options()):
        pass


def test_what_cannot_be_measured_is_rejected(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match=r"speed: no such benchmark; choose from .*geometric, .*neural"):
        bench(["geometric", "speed"])
    for name, ignored in (("diffslam", "source"), ("geometric", "unseen"), ("pose-graph", "set"), ("map", "pairs")):
        argument = {"settings" if ignored == "set" else ignored: [sequence]}
        with pytest.raises(UsageError, match=f"--{ignored}: benchmark {name} does not use it; it uses --"):
            bench([name], out=tmp_path, **argument)
    with pytest.raises(UsageError, match="--only tasks: no such part"):
        bench(["finetune"], out=tmp_path, only="tasks")
    monkeypatch.setenv("DPM2_KITTI", str(tmp_path / "none"))
    with pytest.raises(UsageError, match="none: no KITTI excerpt"):
        bench()
    monkeypatch.setenv("DPM2_KITTI", str(tmp_path))
    with pytest.raises(UsageError, match=r"neither unpack\.py nor sequences"):
        bench()
    with pytest.raises(UsageError, match="memory: give --source"):
        bench(["memory"])
    with pytest.raises(UsageError, match="nonsense"):
        bench(source=[sequence], settings=["slam.nonsense=1"], out=tmp_path)
    blind = tmp_path / "blind"
    (blind / "velodyne").mkdir(parents=True)
    (blind / "velodyne" / "000000.bin").write_bytes(b"\0" * 16)
    with pytest.raises(UsageError, match="blind: the drive has no ground truth"):
        bench(source=[blind], out=tmp_path)
    assert not list(tmp_path.glob("*.json"))


@pytest.mark.long
def test_the_neural_benchmark_measures_pairs_odometry_and_stages(
    sequence: Path,
    tmp_path: Path,
    model: DeepPointMap2,
    noise: np.random.Generator,
) -> None:
    """With random weights: the classical methods for comparison are correct, and refined falls back on points."""
    save_weights(model, tmp_path / "tiny.safetensors", {"steps": "0", "images": "true", "phase": "2"})
    settings = [f"slam.neural.weights={tmp_path}/tiny.safetensors"]
    poses = se3.exp(np.outer(np.arange(4.0), [0, 0, 0.1, 3, 0, 0]))
    samples = [Sample(boxes(noise), T, (make_image(noise),)) for T in poses]
    write_packed(tmp_path / "unseen" / "world", samples, {})
    bench(
        ["neural"], source=[sequence], out=tmp_path, repetitions=1, threads=1, pairs=3,
        settings=settings, unseen=tmp_path / "unseen",
    )  # fmt: skip
    path = tmp_path / "neural.json"
    record = json.loads(path.read_text())
    assert (record["weights"]["preset"], record["weights"]["steps"]) == ("tiny", "0")
    parts = record["parts"]
    assert list(parts) == [
        "synthetic", "real", "odometry", "corruption", "image", "sensors", "overlap", "reference", "speed"
    ]  # fmt: skip
    assert parts["synthetic"]["pairs"]["up to 20 m, any yaw"]["neural"]["pairs"] > 0
    ours = parts["real"]["drives"][sequence.name]
    assert list(ours["consecutive"]) == ["neural", "refined", FITTED]
    assert set(ours["10-20 m"]) >= {"neural", "refined", "geometric"}
    assert ("small_gicp" in ours["10-20 m"]) == (find_spec("small_gicp") is not None)  # from the extra bench
    assert ours["8 apart"]["neural"]["pairs"] == 0  # six frames
    assert parts["odometry"]["drives"][sequence.name]["geometric"]["ape_rmse_m"] < 0.02
    assert set(parts["corruption"]["error_ratio"]) == {"LiDAR obstruction 100 %", "camera failure 100 %"}
    assert {"neural with camera", "neural without camera"} <= set(parts["image"]["pairs"]["tunnel, up to 5 m"])
    assert (tmp_path / "neural_image.png").read_bytes().startswith(b"\x89PNG")
    assert parts["sensors"]["pairs"]["16 beams, up to 12 m"]["neural"]["pairs"] > 0
    assert "rosette, up to 12 m, any yaw" not in parts["sensors"]["pairs"]  # it only looks ahead
    assert 0 <= parts["overlap"]["average_precision"] <= 1
    speed = parts["speed"]["drives"][sequence.name]
    assert speed["stages_ms"]["total"]["median"] > 0
    assert 0 < speed["descriptor_bytes"] < 70_000
    # Existing parts are kept, missing ones are measured, and a requested part is measured again.
    del record["parts"]["overlap"]
    record["parts"]["real"]["seconds"] = record["parts"]["speed"]["seconds"] = -1
    path.write_text(json.dumps(record))
    again = {"source": [sequence], "out": tmp_path, "repetitions": 1, "threads": 1, "pairs": 3,
             "settings": settings, "unseen": tmp_path / "unseen"}  # fmt: skip
    bench(["neural"], **again)
    parts = json.loads(path.read_text())["parts"]
    assert "average_precision" in parts["overlap"]
    assert parts["real"]["seconds"] == -1
    bench(["neural"], only="speed", **again)
    parts = json.loads(path.read_text())["parts"]
    assert parts["speed"]["seconds"] >= 0 > parts["real"]["seconds"]
    with pytest.raises(UsageError, match="--only taste: no such part; choose from synthetic"):
        bench(["neural"], only="taste", **again)


def test_pairs_are_of_their_kind_and_have_a_true_pose() -> None:
    poses = se3.exp(np.outer(np.arange(40.0), [0, 0, 0, 1.5, 0, 0]))
    poses[7] = np.nan
    kinds = pairs_of(poses, most=10)
    assert all(0 < len(pairs) <= 10 for pairs in kinds.values())
    assert all(7 not in pair for pairs in kinds.values() for pair in pairs)
    assert all(b - a == 1 for a, b in kinds["consecutive"])
    assert all(b - a == 8 for a, b in kinds["8 apart"])
    for low in (10, 20, 30, 40):
        assert all(low <= 1.5 * (b - a) <= low + 10 for a, b in kinds[f"{low}-{low + 10} m"])


def test_a_pair_without_an_answer_is_a_failure() -> None:
    rows = np.array([[0.1, 0.2], [0.1, 2.0], [np.inf, np.inf], [0.3, 0.4]])
    assert summarized(rows) == {
        "pairs": 4,
        "median_m": pytest.approx(0.2),
        "median_deg": pytest.approx(1.2),
        "success": 0.5,
    }
    assert summarized(rows[2:3])["median_m"] is None
