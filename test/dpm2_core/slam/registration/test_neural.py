# SPDX-License-Identifier: Apache-2.0
"""Neural registration in the SLAM: which descriptors are used, what is rejected, and what is loaded when."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dpm2_core.descriptors import Descriptors, LazyDescriptors
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Registration, State
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pretrained import load_network
from dpm2_core.network.settings import preset
from dpm2_core.network.tokens import to_tokens
from dpm2_core.network.weights import save_weights
from dpm2_core.slam.build import make_registration, make_slam
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings
from dpm2_core.slam.registration.descriptor_map import DescriptorMap
from dpm2_core.slam.registration.neural import NeuralScanRegistration, NeuralSettings
from dpm2_core.slam.registration.protocol import Prediction
from dpm2_core.slam.registration.spacing import Spacing
from dpm2_core.slam.settings import SlamSettings

from ....helpers.drives import Drive
from ....helpers.networks import tiny
from ....helpers.scenes import boxes, make_image


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """The tiny network as a file. Its weights are random, but its similarities are centered, so that equal descriptors
    match best."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny(decoder={"temperature": 0.01})).eval().requires_grad_(False)
    some = model.describe(Frame(0, cloud(boxes(np.random.default_rng(1)))))
    tokens = to_tokens([some], model.settings.points.view_aligned)
    last = model.decoder.similarity[-1]
    assert isinstance(last.bias, torch.Tensor)
    last.bias -= model.decoder.similarity(model.decoder(tokens, tokens).source).mean((0, 1))
    path = tmp_path / "tiny.safetensors"
    save_weights(model, path, {}, half=False)
    return path


def cloud(xyz: np.ndarray) -> np.ndarray:
    """(N, 4) with intensity."""
    return np.column_stack([xyz, np.full(len(xyz), 0.5)]).astype(np.float32)


def descriptors(noise: np.random.Generator) -> Descriptors:
    return Descriptors.of(noise.normal(size=(5, 3)).astype(np.float32), noise.normal(size=(5, 8)))


def lazy(value: Descriptors | None) -> LazyDescriptors:
    def make() -> Descriptors:
        if value is None:
            raise Dpm2Error("too few points")
        return value

    return LazyDescriptors(make)


def around(places: DescriptorMap, T: np.ndarray, frames: int = 2) -> tuple[np.ndarray, Descriptors]:
    found = places.around(T, frames)
    assert found is not None
    return found


def test_the_nearest_frames_are_merged_in_the_frame_of_the_nearest(noise: np.random.Generator) -> None:
    places = DescriptorMap(Spacing(3, 0), radius=20)
    poses = [se3.exp([0, 0, 0.2 * i, 4.0 * i, 0, 0]) for i in range(4)]
    sets = [descriptors(noise) for _ in poses]
    for pose, s in zip(poses, sets, strict=True):
        places.insert(lazy(s), pose)
    T, merged = around(places, poses[2] @ se3.exp([0, 0, 0, 1.0, 0, 0]))
    np.testing.assert_array_equal(T, poses[2])
    world = se3.transform(T, merged.xyz.astype(np.float64))
    for part, i in ((world[:5], 2), (world[5:], 3)):
        np.testing.assert_allclose(part, se3.transform(poses[i], sets[i].xyz.astype(np.float64)), atol=1e-5)


def test_frames_out_of_reach_are_left_out_unless_there_is_no_other(noise: np.random.Generator) -> None:
    places = DescriptorMap(Spacing(3, 0), radius=10)
    for x in (0.0, 30.0):
        places.insert(lazy(descriptors(noise)), se3.make(np.eye(3), [x, 0, 0]))
    assert len(around(places, se3.make(np.eye(3), [28, 0, 0]))[1]) == 5
    assert len(around(places, se3.make(np.eye(3), [200, 0, 0]))[1]) == 5


def test_a_frame_enters_after_motion_or_a_turn(noise: np.random.Generator) -> None:
    places = DescriptorMap(Spacing(3, 0), radius=20)
    assert places.wants(np.eye(4))
    places.insert(lazy(descriptors(noise)), np.eye(4))
    assert not places.wants(se3.exp([0, 0, 0.1, 2.9, 0, 0]))
    assert places.wants(se3.exp([0, 0, 0, 3.1, 0, 0]))
    assert places.wants(se3.exp([0, 0, 0.3, 0, 0, 0]))


def test_frames_are_described_when_they_are_registered_to(noise: np.random.Generator) -> None:
    """A frame with too few points for descriptors is skipped. Without any descriptors there is nothing to register
    to."""
    places = DescriptorMap(Spacing(3, 0), radius=20)
    described = [lazy(None), lazy(descriptors(noise)), lazy(descriptors(noise))]
    for i, one in enumerate(described):
        places.insert(one, se3.make(np.eye(3), [4.0 * i, 0, 0]))
    assert places.around(np.eye(4), 2) is not None
    assert [one.made for one in described] == [True, True, False]
    T, _ = around(places, np.eye(4))
    np.testing.assert_array_equal(T[:3, 3], [4, 0, 0])
    empty = DescriptorMap(Spacing(3, 0), radius=20)
    empty.insert(lazy(None), np.eye(4))
    assert empty.around(np.eye(4), 2) is None


def test_a_fault_of_the_network_reaches_the_user_in_its_own_words(noise: np.random.Generator) -> None:
    broken = DeepPointMap2(tiny()).eval()
    with torch.no_grad():
        next(broken.encoder.parameters()).fill_(torch.nan)
    registration = NeuralScanRegistration(NeuralSettings(), Preprocessor(PreprocessSettings()), broken)
    scan = registration.prepare(Frame(0, cloud(boxes(noise))), np.zeros(6))
    assert "not finite" in registration.rejection(scan)
    assert "not finite" in registration.register(scan, Prediction([np.eye(4)])).reason


def test_memory_is_bounded(noise: np.random.Generator) -> None:
    places = DescriptorMap(Spacing(3, 0), radius=20)
    for i in range(100):
        places.insert(lazy(descriptors(noise)), se3.make(np.eye(3), [3.0 * i, 0, 0]))
    assert len(places) == 20


def test_a_frame_seen_again_is_found_without_any_prior(weights: Path, noise: np.random.Generator) -> None:
    """This holds for any weights: equal descriptors match, and untrained offsets are zero."""
    s = SlamSettings(registration="neural", neural=NeuralSettings(weights=str(weights), min_confidence=0))
    registration = make_registration(s)
    frame = Frame(0, cloud(boxes(noise)))
    scan = registration.prepare(frame, np.zeros(6))
    place = se3.exp([0.02, 0.01, 1.3, 50.0, -20.0, 1.0])
    registration.update(scan, place)
    wrong = se3.exp([0, 0, -2.0, 900.0, 10.0, 0])
    result = registration.register(scan, Prediction([wrong]))
    assert (result.ok, result.method) == (True, "neural")
    np.testing.assert_allclose(result.T_target_source, place, atol=1e-3)  # fp16 features, bf16 arithmetic
    assert np.linalg.eigvalsh(result.covariance)[0] > 0
    # But if the velocity is known to 1 m/s, a result that contradicts it is rejected.
    known = registration.register(scan, Prediction([wrong], information=np.eye(6) / 0.1**2))
    assert (known.ok, known.reason) == (False, "contradicts the motion so far")
    assert registration.register(scan, Prediction([place], information=np.eye(6) / 0.1**2)).ok


def test_standing_still_from_the_first_frame_to_a_keyframe_with_descriptors(
    weights: Path, noise: np.random.Generator
) -> None:
    s = SlamSettings(registration="neural", neural=NeuralSettings(weights=str(weights), min_confidence=0))
    slam = make_slam(s)
    points = cloud(boxes(noise))
    tracked = [slam.process(Frame(i * 10**8, points, index=i)).odometry for i in range(4)]
    assert all(t.registration.ok for t in tracked)
    np.testing.assert_allclose(tracked[-1].T_odom_lidar, np.eye(4), atol=0.01)
    keyframe = tracked[0].keyframe
    assert keyframe is not None
    assert keyframe.descriptors is not None
    assert len(keyframe.descriptors) == 48


def test_bad_frames_are_rejected_in_words_and_survived(weights: Path, noise: np.random.Generator) -> None:
    s = SlamSettings(registration="neural", neural=NeuralSettings(weights=str(weights), min_confidence=0))
    slam = make_slam(s)
    points = cloud(boxes(noise))
    good = [Frame(i * 10**8, points, index=i) for i in range(7)]
    bad = [np.zeros((0, 4)), np.full((500, 4), np.nan), points[:10]]
    frames = [Frame(0, bad[0].astype(np.float32)), *good[:3]]
    frames += [Frame((3 + i) * 10**8, b.astype(np.float32)) for i, b in enumerate(bad)] + [good[6]]
    tracked = [slam.process(frame).odometry for frame in frames]
    for t in (tracked[0], *tracked[4:7]):
        assert not t.registration.ok
        assert re.search(r"scan has \d+ points within .* m, want \d+", t.registration.reason)
    assert tracked[6].state == State.DEGRADED
    assert tracked[-1].registration.ok
    assert all(np.isfinite(t.T_odom_lidar).all() and np.isfinite(t.covariance).all() for t in tracked)


def test_another_place_is_no_answer(weights: Path, noise: np.random.Generator) -> None:
    """The same place is accepted, with another scan."""
    s = SlamSettings(registration="neural", neural=NeuralSettings(weights=str(weights)))
    registration = make_registration(s)
    here, elsewhere = (cloud(boxes(noise)) for _ in range(2))
    again = here + noise.normal(0, 0.02, here.shape).astype(np.float32)
    first, second, other = (registration.prepare(Frame(0, points), np.zeros(6)) for points in (here, again, elsewhere))
    registration.update(first, np.eye(4))
    assert registration.register(second, Prediction([np.eye(4)])).ok
    result = registration.register(other, Prediction([np.eye(4)]))
    assert not result.ok
    assert "of the matched descriptors fit one motion" in result.reason


def test_in_a_search_for_a_place_a_pose_must_be_probable(noise: np.random.Generator) -> None:
    """Nothing else would contradict a place that looks alike; a known motion can."""
    torch.manual_seed(0)
    network, here = DeepPointMap2(tiny()).eval(), cloud(boxes(noise))

    def register(probability: float, unique: bool) -> Registration:
        with torch.no_grad():
            network.decoder.confidence.weight.zero_()
            network.decoder.confidence.bias.fill_(float(np.log(probability / (1 - probability))))
        registration = NeuralScanRegistration(NeuralSettings(), Preprocessor(PreprocessSettings()), network)
        scan = registration.prepare(Frame(0, here), np.zeros(6))
        registration.update(scan, np.eye(4))
        return registration.register(scan, Prediction([np.eye(4)], unique=unique))

    assert register(0.7, True).ok
    assert register(0.3, False).ok
    assert register(0.3, True).reason == "right with a probability of only 30%"
    assert not register(0.05, False).ok


def test_images_are_asked_for_and_used_where_the_network_has_a_camera(noise: np.random.Generator) -> None:
    torch.manual_seed(0)
    preprocessor = Preprocessor(PreprocessSettings())
    frame = Frame(0, cloud(boxes(noise)), images=(make_image(noise),))
    for backbone, requested in (("convnext", True), ("none", False)):
        model = DeepPointMap2(tiny(image={"backbone": backbone})).eval().requires_grad_(False)
        registration = NeuralScanRegistration(NeuralSettings(), preprocessor, model)
        assert registration.uses_images is requested
        with_image, without = (
            registration.prepare(f, np.zeros(6)).descriptors for f in (frame, Frame(0, frame.points))
        )
        assert with_image is not None
        assert without is not None
        assert np.array_equal(with_image.features, without.features) is not requested


@pytest.mark.parametrize("registration", ["neural", "refined", "geometric"])
def test_a_keyframe_of_a_lidar_that_hangs_is_described_as_one_that_stands(
    weights: Path, noise: np.random.Generator, registration: Any
) -> None:
    s = SlamSettings(registration=registration, neural=NeuralSettings(weights=str(weights), min_confidence=0))
    points, described = cloud(boxes(noise)), []
    for up in (1.0, -1.0):
        slam = make_slam(s)
        keyframe = slam.process(Frame(0, points * np.float32([1, up, up, 1]), up=(0.0, 0.0, up))).odometry.keyframe
        assert keyframe is not None
        described.append(slam.mapper.described(keyframe).descriptors)
    standing, hanging = described
    np.testing.assert_array_equal(hanging.features, standing.features)
    assert (standing.up, hanging.up.tolist()) == (None, [0, 0, -1])


def test_what_is_remembered_of_a_scan_gives_its_descriptors(noise: np.random.Generator) -> None:
    """A kept scan, reduced and with a small image, has the descriptors that the whole scan would have had."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny()).eval().requires_grad_(False)
    registration = NeuralScanRegistration(NeuralSettings(), Preprocessor(PreprocessSettings()), model)
    first, second = (
        registration.prepare(Frame(0, cloud(boxes(noise)), images=(make_image(noise),)), np.zeros(6)) for _ in range(2)
    )
    results = []
    for described in (False, True):
        registration = registration.fresh()
        if described:
            assert first.descriptors is not None
        registration.keep(first, np.eye(4))
        results.append(registration.register(second, Prediction([np.eye(4)])))
    np.testing.assert_allclose(results[0].T_target_source, results[1].T_target_source, atol=1e-9)


def test_descriptors_of_a_keyframe_take_86_kb(noise: np.random.Generator) -> None:
    torch.manual_seed(0)
    model = DeepPointMap2(preset("small")).eval().requires_grad_(False)
    result = model.describe(Frame(0, cloud(boxes(noise, 20_000))))
    assert (len(result), result.features.dtype) == (320, np.int8)
    assert result.nbytes <= 86_000


def test_missing_weights_and_what_is_none_are_errors_of_use() -> None:
    with pytest.raises(UsageError, match="nowhere: no such file; weights shipped with dpm2"):
        load_network("nowhere", 1)
    with pytest.raises(UsageError, match="not a safetensors file"):
        load_network(__file__, 1)


@pytest.mark.parametrize(("about", "camera"), [({"images": "true"}, True), ({"images": "false"}, False), ({}, False)])
def test_a_camera_branch_that_was_never_trained_is_left_out(
    model: DeepPointMap2, tmp_path: Path, about: dict[str, str], camera: bool
) -> None:
    save_weights(model, tmp_path / "w.safetensors", about)
    assert (load_network(str(tmp_path / "w.safetensors"), 1).encoder.image is not None) is camera


def test_threads_are_those_of_the_settings(weights: Path) -> None:
    load_network(str(weights), 3)
    assert torch.get_num_threads() == 3


@pytest.mark.slow
def test_the_geometric_slam_imports_neither_torch_nor_matplotlib() -> None:
    """torch takes seconds and 200 MB, which is useless if no loop uses descriptors."""
    program = (
        "import sys, numpy as np; from dpm2_core.slam.build import SlamSettings, make_slam; "
        "from dpm2_core.frame import Frame; import dpm2_core.commands.run; "
        "points = np.random.default_rng(0).uniform(-20, 20, (3000, 4)).astype(np.float32); "
        "slam = make_slam(SlamSettings(registration='geometric', loops={'descriptors': False})); "
        "[slam.process(Frame(i, points)) for i in range(2)]; "
        "sys.exit(len({'torch', 'matplotlib'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=120).returncode == 0


@pytest.mark.weights
@pytest.mark.slow
def test_the_papers_slam_follows_a_street(suburb_drive: Drive) -> None:
    """All of its methods at once. Its odometry registers to keyframes 10 m apart, and is less accurate than ours."""
    frames, truth = suburb_drive
    slam = make_slam(SlamSettings(preset="paper"))
    tracked = [slam.process(frame).odometry for frame in frames[:10]]
    assert {t.registration.method for t in tracked[1:]} == {"neural"}
    assert all(t.registration.ok for t in tracked)
    off = [np.linalg.norm((t.T_odom_lidar - T)[:3, 3]) for t, T in zip(tracked, truth, strict=False)]
    assert max(off) < 0.5


@pytest.mark.weights
@pytest.mark.slow
def test_a_scan_that_enters_the_map_is_registered_once_more(suburb_drive: Drive) -> None:
    frames, truth = suburb_drive
    ends = []
    for refined in (0, 16):
        neural = NeuralSettings(frames=1, refined=refined)
        registration = make_registration(SlamSettings(registration="neural", neural=neural))
        for i in (0, 4, 12, 8):
            registration.update(registration.prepare(frames[i], np.zeros(6)), truth[i])
        for i in (6, 9):  # between two frames of the map, which together are more accurate than the nearest alone
            scan = registration.prepare(frames[i], np.zeros(6))
            ends.append(registration.register(scan, Prediction([truth[i]])).T_target_source)
    assert not np.array_equal(ends[0], ends[2])  # farther than `spacing` from the last frame
    assert np.array_equal(ends[1], ends[3])
    assert np.linalg.norm((ends[2] - truth[6])[:3, 3]) < 0.2
