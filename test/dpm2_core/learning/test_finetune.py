# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning: gradients of the trajectory against differences, references by SLAM, resuming, and invalid requests."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dpm2_core.data.open import open_source
from dpm2_core.data.packed import Sample, open_packed, write_packed
from dpm2_core.diffslam.trajectory_loss import trajectory_loss
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.learning.finetune import draw_road_segment, finetune, window_trajectories
from dpm2_core.learning.finetune_data import Referenced, prepare, refer
from dpm2_core.learning.finetune_settings import FinetuneSettings
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.tokens import Tokens
from dpm2_core.network.weights import load_model, read_metadata, save_weights
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, LidarConfig
from dpm2_core.sim.simulated_drive import RIDES, TurningRobot
from dpm2_core.sim.world import build_world
from dpm2_core.slam.settings import SlamSettings

from ...helpers.command import dpm2
from ...helpers.drives import InMemory
from ...helpers.networks import tiny
from ...helpers.training import stopped

GEOMETRIC = SlamSettings(registration="geometric", loops={"descriptors": False}, threads=1)  # type: ignore[arg-type]
"""A reference by geometric registration alone: what follows is the same as with the network, which takes most time."""

GEOMETRIC = SlamSettings(registration="geometric", loops={"descriptors": False}, threads=1)  # type: ignore[arg-type]
"""A reference by geometric registration alone: what follows is the same as with the network, which takes most time."""


def descriptors(poses: torch.Tensor, channels: int) -> Tokens:
    """Tokens of G * F scans of the same 60 places, each with the same feature in every scan; poses (G, F, 4, 4)."""
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(60, 3, generator=generator, dtype=torch.float64) * torch.tensor([15.0, 15.0, 1.0])
    features = torch.randn(60, channels, generator=generator)
    inverse = torch.linalg.inv(poses.flatten(0, 1))
    xyz = (places @ inverse[:, :3, :3].mT + inverse[:, None, :3, 3]).float()
    axis = torch.nn.functional.normalize(xyz[..., :2], dim=-1)
    scans = len(xyz)
    return Tokens(xyz, features.expand(scans, 60, channels).clone(), axis, torch.ones(scans, 60, dtype=torch.bool))


@pytest.fixture
def road() -> torch.Tensor:
    """(1, 3, 4, 4) poses along a bend."""
    return torch.from_numpy(np.stack([se3.exp([0, 0, 0.05 * i, 2.0 * i, 0.1 * i, 0]) for i in range(3)])[None])


def test_the_gradient_of_the_trajectory_is_that_of_differences(road: torch.Tensor) -> None:
    """With respect to one coordinate of one descriptor, to 2 %: the last least-squares steps carry the gradient."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny()).eval()
    tokens = descriptors(road, model.settings.channels)
    reference = torch.linalg.inv(road[:, :1]) @ road
    xyz = tokens.xyz.clone().requires_grad_(True)

    def loss(xyz: torch.Tensor) -> torch.Tensor:
        found, diverged = window_trajectories(model.decoder, tokens._replace(xyz=xyz), road)
        assert float(diverged) == 0.0
        return trajectory_loss(found[0], reference[0])

    (slope,) = torch.autograd.grad(loss(xyz), xyz)
    assert bool(slope.isfinite().all())
    scan, place, axis = np.unravel_index(int(slope.abs().argmax()), slope.shape)
    step = 2e-3
    moved = [xyz.detach().clone() for _ in range(2)]
    for sign, cloud in zip((1, -1), moved, strict=True):
        cloud[scan, place, axis] += sign * step
    with torch.no_grad():
        difference = (loss(moved[0]) - loss(moved[1])) / (2 * step)
    assert float(slope[scan, place, axis]) == pytest.approx(float(difference), rel=0.02)


def test_a_scan_that_matches_nothing_diverges_without_a_gradient_or_nan(road: torch.Tensor) -> None:
    torch.manual_seed(0)
    model = DeepPointMap2(tiny()).eval()
    tokens = descriptors(road, model.settings.channels)
    xyz = tokens.xyz.clone()
    xyz[1] = 30 * torch.randn_like(xyz[1])
    xyz.requires_grad_(True)
    found, diverged = window_trajectories(model.decoder, tokens._replace(xyz=xyz), road)
    assert float(diverged) > 0
    torch.testing.assert_close(found[0, 1], (torch.linalg.inv(road[0, 0]) @ road[0, 1]), atol=1e-9, rtol=0)
    found.sum().backward()
    assert xyz.grad is not None
    assert bool(xyz.grad.isfinite().all())


def test_a_stretch_is_in_the_order_of_the_road() -> None:
    poses = np.tile(np.eye(4), (50, 1, 1))
    order = np.random.default_rng(1).permutation(50)
    poses[:, 0, 3] = order
    for seed in range(10):
        along = order[draw_road_segment(poses, np.random.default_rng(seed), 4, 15.0)]
        steps = np.diff(along)
        assert (steps > 0).all() or (steps < 0).all()
        assert abs(along[-1] - along[0]) <= 30


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finetune") / "drive"
    simulate(
        out,
        DriveConfig(
            frames=24,
            seed=5,
            road="straight",
            preset="suburb",
            images=False,
            lidar=LidarConfig(beams=32, columns=600, height=2.2),
        ),
    )
    return out


@pytest.fixture
def settings(tmp_path: Path, packed: Path) -> FinetuneSettings:
    torch.manual_seed(0)
    path = tmp_path / "start.safetensors"
    save_weights(DeepPointMap2(tiny()), path, {"images": "false", "phase": "2"}, half=False)
    optimizer = {"steps": 4, "warmup": 1, "bf16": False, "save_every": 2, "rate": 1e-3}
    chosen = {"rehearsal": str(packed), "pairs": 1.0, "groups": 1, "frames": 3, "optimiser": optimizer}
    return FinetuneSettings(weights=str(path), **chosen)  # type: ignore[arg-type]


def _truth(recording: Path) -> Array:
    poses = open_source(recording).poses
    assert poses is not None
    return poses


@pytest.mark.slow
def test_the_reference_is_the_trajectory_of_the_slam_and_frames_without_one_have_none(recording: Path) -> None:
    """No ground truth is used: from scan to scan the reference is within 2 cm of it."""
    referenced = refer(open_source(recording), SlamSettings(threads=1))
    truth = _truth(recording)
    steps = [se3.inverse(poses[:-1]) @ poses[1:] for poses in (referenced.poses, truth)]
    assert np.linalg.norm(steps[0][:, :3, 3] - steps[1][:, :3, 3], axis=1).max() < 0.02


def carried(frame: Frame) -> Frame:
    """After eight frames the recording continues 20 s later in another place: the mirror image."""
    if frame.index < 8:
        return frame
    return replace(frame, points=frame.points * np.float32([1, -1, 1, 1]), stamp=frame.stamp + 20 * 10**9)


@pytest.mark.slow
def test_scans_on_two_sides_of_a_pause_that_is_not_bridged_are_no_pair(recording: Path) -> None:
    """The pose of the second part relative to the first is only a guess, and must not be used for training or
    evaluation. The last scan before the pause is left out: the motion to the next scan, which its de-skewing needs, is
    invalid."""
    referenced = refer(InMemory([*map(carried, open_source(recording).frames())]), GEOMETRIC)
    poses, truth = referenced.poses, _truth(recording)
    there = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    before, after = there[there < 8], there[there >= 8]
    assert before.tolist() == [*range(7)]
    assert len(after) > 5
    between = poses[before, None, :3, 3] - poses[after, :3, 3]
    assert np.linalg.norm(between, axis=-1).min() > 1000
    assert len(referenced.notes) == 1
    assert "the relative poses of 2 parts of the drive" in referenced.notes[0]
    for part in (before, after):
        way = [np.linalg.norm(np.diff(of[part, :3, 3], axis=0), axis=1) for of in (poses, truth)]
        assert np.abs(way[0] - way[1]).max() < 0.02


@pytest.mark.slow
def test_times_that_the_motion_contradicts_do_not_bend_what_is_learned_from() -> None:
    """The SLAM detects that the clouds are de-skewed already, and they are packed as they are; previously, they were
    de-skewed a second time."""
    lidar = LidarConfig(beams=32, columns=512, height=1.4, car_body=False)
    robot = TurningRobot(build_world("loop", "suburb", seed=1, length=300.0), 40, RIDES["waved"], lidar)
    frames = []
    for frame in robot.frames():
        time = robot.times[frame.index]
        T = se3.inverse(robot.pose(np.array([time]))) @ robot.pose(time + frame.time_offset)
        points = frame.points.copy()
        points[:, :3] = np.einsum("nij,nj->ni", T[:, :3, :3], points[:, :3]) + T[:, :3, 3]
        frames.append(replace(frame, points=points))
    referenced = refer(InMemory(frames), GEOMETRIC)
    assert all(frame.time_offset is None for frame in referenced.frames())
    assert referenced.notes == ["the point times are not used, because the motion contradicts them"]


@pytest.mark.long
def test_a_stopped_training_goes_on_to_the_same_weights(
    recording: Path, tmp_path: Path, settings: FinetuneSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The weights also carry the metadata of those that they started from."""
    data = tmp_path / "data"
    network = load_model(Path(settings.weights)).settings
    prepare([open_source(recording)], settings, network, SlamSettings(threads=1), data)
    assert sum(len(packed) for packed in open_packed(data / "drives")) == 20
    other = settings.model_copy(update={"held_out": 0.4})  # with another part held out, it continued without a message
    with pytest.raises(UsageError, match=f"{data}.*: made with held_out {settings.held_out}, not 0.4; remove it"):
        prepare([open_source(recording)], other, network, SlamSettings(threads=1), data)
    with pytest.raises(UsageError, match=r"00_\w+: is of a drive that was not given; remove it"):
        prepare([], settings, network, SlamSettings(threads=1), data)  # that drive was used for training, too
    whole = finetune(settings, tmp_path / "whole", data=data)
    stopped(lambda: finetune(settings, tmp_path / "parts", data=data), monkeypatch)
    parts = finetune(settings, tmp_path / "parts", data=data)
    one, other, start = (load_model(path).state_dict() for path in (whole, parts, Path(settings.weights)))
    for name, value in one.items():
        torch.testing.assert_close(value, other[name], atol=1e-6, rtol=0)
    assert any(not torch.equal(value, start[name]) for name, value in one.items())
    metadata = read_metadata(whole)
    assert (metadata["phase"], metadata["finetuned_from"]) == ("2", "start")


@pytest.mark.long
def test_the_reference_leaves_as_many_threads_as_there_were(
    recording: Path, packed: Path, tmp_path: Path, settings: FinetuneSettings
) -> None:
    """The number of threads after the reference's SLAM is as before it. Previously, training used fewer threads than
    --resume, which computes no reference, and other weights resulted."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        asked = ["--set", f"weights={settings.weights}", "--set", f"rehearsal={packed}", "--set", "optimiser.steps=1"]
        done = dpm2("finetune", recording, "--out", tmp_path / "o", *asked, "--set", "frames=3")
        assert done.returncode == 0, done.stderr
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_a_drive_that_cannot_be_followed_is_an_error_of_use(
    recording: Path, tmp_path: Path, settings: FinetuneSettings
) -> None:
    network = load_model(Path(settings.weights)).settings
    source = open_source(recording)
    blind = SlamSettings(threads=1, preprocess={"min_range": 79.0, "max_range": 80.0})  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="too few to train on"):
        prepare([source], settings, network, blind, tmp_path / "data")


@pytest.mark.slow
def test_a_held_out_part_is_measured_where_it_has_pairs_and_named_where_it_has_none(
    recording: Path, tmp_path: Path, settings: FinetuneSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last four scans are within 5 m, the last ten are not; scans 7 m apart have no near pair."""
    network = load_model(Path(settings.weights)).settings
    for held_out, every, measured in ((0.15, 1, False), (0.4, 1, True), (0.5, 8, False)):
        source = open_source(recording)
        poses = _truth(recording).copy()
        poses[:, :3, 3] *= every
        chosen = settings.model_copy(update={"held_out": held_out})
        out = tmp_path / f"{held_out}"
        reference = Referenced(source, poses)
        monkeypatch.setattr("dpm2_core.learning.finetune_data.refer", lambda *_, r=reference: r)
        notes = prepare([source], chosen, network, SlamSettings(), out)
        assert (out / "held_out").exists() is measured
        assert [" that are held out have no pairs up to 5 m" in note for note in notes] == ([] if measured else [True])
        assert sum(len(packed) for packed in open_packed(out / "drives")) == round(24 * (1 - held_out))


@pytest.mark.slow
def test_errors_of_use_are_one_line(recording: Path, tmp_path: Path, settings: FinetuneSettings) -> None:
    for arguments, message in (
        ([str(tmp_path / "none")], "none"),
        ([str(recording), "--set", "weights=nowhere"], "nowhere: no such file"),
        ([str(recording), "--set", "trajectry=1"], "unknown key trajectry"),
        ([str(recording), "--resume"], "no checkpoint.pt to resume"),
    ):
        done = dpm2("finetune", *arguments, "--out", tmp_path / "o")
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "o").exists()  # as for every request that cannot be carried out


def test_other_drives_in_the_rehearsal_are_not_gone_on_with(
    recording: Path, packed: Path, samples: list[Sample], tmp_path: Path, settings: FinetuneSettings
) -> None:
    """If the drives for the rehearsal changed, --resume is an error. Previously, other weights resulted without a
    message."""
    short = tmp_path / "short" / "velodyne" / "000000.bin"
    short.parent.mkdir(parents=True)
    shutil.copy(recording / "sequences" / "00" / "velodyne" / "000000.bin", short)
    asked = ["finetune", tmp_path / "short", "--out", tmp_path / "o", "--set", f"weights={settings.weights}"]
    asked += ["--set", f"rehearsal={packed}"]
    assert "too few to train on" in dpm2(*asked).stderr  # after the request has been recorded
    (tmp_path / "o" / "checkpoint.pt").touch()
    assert "too few to train on" in dpm2(*asked, "--resume").stderr
    write_packed(packed / "another", samples[:2], {"source": "boxes"})
    assert "began with content of rehearsal" in dpm2(*asked, "--resume").stderr
