# SPDX-License-Identifier: Apache-2.0
"""Training data: packing, augmentation that preserves the ground truth, and groups."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.spatial import cKDTree

from dpm2_core.data.packed import QUANTUM, PackedDrive, Sample, open_packed, packed_digest, write_packed
from dpm2_core.descriptors import Descriptors, merge
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.geometry import se3
from dpm2_core.learning.augment import AugmentSettings, augment
from dpm2_core.learning.dataset import DataSettings, GroupDataset, Mixture, draw_group
from dpm2_core.learning.pair_sampling import merge_tokens, sample_set_pairs
from dpm2_core.learning.train_overlap import average_precision, draw_overlap
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.tokens import to_tokens

from ...helpers.networks import tiny

NOTHING = {"drop": 0, "occlusion": 0, "beams": 0, "jitter": 0, "yaw": 0, "tilt": 0, "shift": (0, 0, 0), "image_drop": 0}


def test_packing_keeps_clouds_to_a_millimeter(packed: Path, samples: list[Sample]) -> None:
    """Points to half a quantum, poses and images exactly."""
    drive = PackedDrive(packed / "world")
    assert len(drive) == len(samples)
    for result, true in zip((drive[i] for i in range(len(drive))), samples, strict=True):
        assert np.abs(result.cloud - true.cloud).max() <= QUANTUM / 2 + 1e-5
        assert np.array_equal(result.pose, true.pose)
        assert np.array_equal(result.images[0].pixels, true.images[0].pixels)
        assert np.array_equal(result.images[0].camera.T_lidar_cam, true.images[0].camera.T_lidar_cam)


def test_an_unfinished_drive_is_not_opened(packed: Path, samples: list[Sample], tmp_path: Path) -> None:
    """A killed run leaves another name, which the next run replaces; the name of the parent folder does not matter."""
    root = tmp_path / "root.parts"
    left = root / f".new.{os.getpid()}.part"
    shutil.copytree(packed / "world", left)
    with pytest.raises(UsageError, match="no packed drive"):
        open_packed(root)
    write_packed(root / "new", samples, {})
    assert [drive.name for drive in open_packed(root)] == ["new"]
    assert not left.exists()


@pytest.mark.parametrize("weight", [0, None])
def test_without_a_drive_of_some_weight_there_is_nothing_to_learn(packed: Path, weight: float | None) -> None:
    with pytest.raises(UsageError, match=r"data\.packed: no packed drives"):
        Mixture(DataSettings(packed={} if weight is None else {str(packed): weight}))


def test_images_that_no_drive_has_are_not_learned_from(samples: list[Sample], tmp_path: Path) -> None:
    """`data.images` without images is an error. Previously, only LiDAR data was learned, but the metadata of the
    weights stated that they use images."""
    write_packed(tmp_path / "one", [sample._replace(images=()) for sample in samples], {})
    settings = DataSettings(packed={str(tmp_path): 1.0}, images=True)
    with pytest.raises(UsageError, match=r"data\.images: no drive of data\.packed has images"):
        GroupDataset(settings, tiny(), settings.draw, 0)


@pytest.mark.parametrize("frame", [0, -1])
def test_drives_that_differ_in_their_images_alone_are_told_apart(
    samples: list[Sample], tmp_path: Path, frame: int
) -> None:
    """Drives with the same points and poses, as of a world at another time of day, or with the same pixels of another
    camera, have different digests."""
    image = samples[frame].images[0]
    turned = replace(image.camera, T_lidar_cam=image.camera.T_lidar_cam @ se3.exp([0, 0, 0.1, 0, 0, 0]))
    others = [image, replace(image, pixels=255 - image.pixels), replace(image, camera=turned)]
    for number, other in enumerate(others):
        changed = list(samples)
        changed[frame] = samples[frame]._replace(images=(other,))
        write_packed(tmp_path / str(number) / "world", changed, {})
    write_packed(tmp_path / "again" / "world", samples, {})
    digests = [packed_digest(open_packed(tmp_path / name)) for name in ("0", "1", "2", "again")]
    assert len(set(digests)) == 3
    assert digests[0] == digests[3]


def test_foreign_folders_are_rejected(tmp_path: Path) -> None:
    """Folders without poses or of another format are rejected."""
    (tmp_path / "about.json").write_text("{}")
    with pytest.raises(UsageError, match="no packed drive"):
        open_packed(tmp_path)


def test_augmentation_keeps_points_where_they_are_in_the_world(samples: list[Sample]) -> None:
    """After a rigid motion of the sensor frame, pose times cloud is the same set of points; the same holds for the
    camera."""
    sample = samples[0]
    motion = {"yaw": 3, "tilt": 0.1, "shift": (2, 2, 1), "extrinsic_rotation": 0, "extrinsic_translation": 0}
    changed = augment(sample, AugmentSettings(**{**NOTHING, **motion}), np.random.default_rng(0))
    assert not np.allclose(changed.pose, sample.pose)
    assert len(changed.cloud) == len(sample.cloud)
    tree = cKDTree(se3.transform(sample.pose, sample.cloud.astype(np.float64)))
    distance, index = tree.query(se3.transform(changed.pose, changed.cloud.astype(np.float64)))
    assert distance.max() < 1e-4
    assert len(set(index)) == len(index)
    before, after = (s.pose @ s.images[0].camera.T_lidar_cam for s in (sample, changed))
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_occlusion_removes_what_lies_behind(samples: list[Sample]) -> None:
    """Sectors lose only their far points, nothing nearer than 2 m, and never the whole scan."""
    settings = AugmentSettings(**{**NOTHING, "occlusion": 1})
    cloud = samples[0].cloud
    sizes = set()
    for seed in range(10):
        kept = augment(samples[0], settings, np.random.default_rng(seed)).cloud
        sizes.add(len(kept))
        near = np.linalg.norm(cloud, axis=1) < 2
        assert (np.linalg.norm(kept, axis=1) < 2).sum() == near.sum()
        assert len(kept) >= 128
    assert len(sizes) > 5


def test_images_are_dropped_blacked_and_exposed(samples: list[Sample]) -> None:
    """Each happens always if its probability is 1; pixels stay bytes."""
    noise = np.random.default_rng(0)
    assert augment(samples[0], AugmentSettings(**{**NOTHING, "image_drop": 1}), noise).images == ()
    (black,) = augment(samples[0], AugmentSettings(**NOTHING, image_black=1), noise).images
    assert not black.pixels.any()
    (exposed,) = augment(samples[0], AugmentSettings(**NOTHING, image_black=0, exposure=1), noise).images
    assert exposed.pixels.dtype == np.uint8
    assert exposed.pixels.mean() != samples[0].images[0].pixels.mean()


def test_groups_are_near_and_spread() -> None:
    """All within the radius of the first, half of them within a quarter of it, one in seven beyond three quarters."""
    poses = np.tile(np.eye(4), (400, 1, 1))
    poses[:, 0, 3] = np.arange(400) * 0.5
    noise = np.random.default_rng(0)
    distances = []
    for _ in range(200):
        chosen = draw_group(poses, noise, 4, 20)
        assert len(set(chosen)) == 4
        distances += list(np.abs(poses[chosen[1:], 0, 3] - poses[chosen[0], 0, 3]))
    assert max(distances) <= 20
    share = np.histogram(distances, 4, (0, 20))[0] / len(distances)
    expected = np.diff(np.sqrt([0, 0.25, 0.5, 0.75, 1]))
    np.testing.assert_allclose(share, expected, atol=0.05)  # 600 distances: 2 sigma is 0.04


def test_the_radius_may_be_another_where_all_looks_alike(tmp_path: Path) -> None:
    """The radius can be set for each kind of place: in a tunnel, pairs far apart taught the network to match structures
    that are not the same."""
    cloud = np.zeros((0, 3), np.float32)
    samples = [Sample(cloud, se3.make(np.eye(3), [x, 0, 0]), ()) for x in np.arange(100.0)]
    settings = DataSettings(radius=50, radii={"tunnel": 15})
    for preset, farthest in (("tunnel", 15), ("city", 50)):
        write_packed(tmp_path / preset, samples, {"preset": preset})
        (drive,) = open_packed(tmp_path / preset)
        places = [settings.draw(drive, np.random.default_rng(seed)) for seed in range(50)]
        apart = [abs(place[1:] - place[0]).max() for place in places]
        assert 0.8 * farthest < max(apart) <= farthest


@pytest.mark.parametrize("setting", [{"emphasis": {"citty": 100}}, {"radii": {"tunel": 1}}])
def test_an_unknown_place_is_rejected(setting: dict) -> None:
    """A misspelled place is an error. Previously, it was accepted without any effect."""
    with pytest.raises(ValidationError, match="there are city, suburb, rural"):
        DataSettings(**setting)


def test_a_lonely_frame_is_its_own_group() -> None:
    """Without a neighbor within the radius, the frame repeats."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 100
    assert len(set(draw_group(poses, np.random.default_rng(0), 3, 20))) == 1


def test_overlap_groups_have_half_positives_and_hard_negatives() -> None:
    """Two of four within 20 m, one within 20 to 40 m, one beyond."""
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = np.arange(200)
    noise = np.random.default_rng(0)
    for _ in range(50):
        chosen = draw_overlap(poses, noise)
        distance = np.abs(poses[chosen[1:], 0, 3] - poses[chosen[0], 0, 3])
        assert (distance[:2] <= 20).all()
        assert 20 < distance[2] <= 40 < distance[3]


def test_average_precision_of_known_rankings() -> None:
    """If all are ranked correctly it is 1; one positive ranked second gives a half."""
    assert average_precision(np.array([0.9, 0.8, 0.1]), np.array([True, True, False])) == 1
    assert average_precision(np.array([0.9, 0.8, 0.1]), np.array([False, True, False])) == 0.5


def test_batches_depend_on_their_number_alone(packed: Path) -> None:
    """A resumed run, with any number of workers, receives the same batches."""
    settings = DataSettings(packed={str(packed): 1.0}, groups=1, frames=2, images=True, workers=0)
    data = GroupDataset(settings, tiny(), settings.draw, seed=3)
    later = GroupDataset(settings.model_copy(update={"workers": 2}), tiny(), settings.draw, seed=3)
    for step, batch in zip(range(2, 5), later.batches(2, 0), strict=False):
        again = data[step, 0]
        assert torch.equal(again.points.xyz, batch.points.xyz)
        assert torch.equal(again.poses, batch.poses)
    assert not torch.equal(data[0, 0].points.xyz, data[1, 0].points.xyz)


@pytest.mark.parametrize("every", [False, True])
def test_a_scan_that_shows_nothing_does_not_end_a_training(samples: list[Sample], tmp_path: Path, every: bool) -> None:
    """If a scan is nearly empty, as next to a truck, another place is drawn. It is an error only if there is no other
    place."""
    nothing = [sample._replace(cloud=sample.cloud[:3]) for sample in samples]
    write_packed(tmp_path / "world", nothing if every else [*samples, nothing[0]], {})
    settings = DataSettings(packed={str(tmp_path): 1.0}, groups=1, frames=2)
    data = GroupDataset(settings, tiny(), settings.draw, seed=0)
    if every:
        with pytest.raises(Dpm2Error, match="each has a scan of fewer than 256 points"):
            data[0, 0]
        return
    for step in range(20):
        assert torch.isfinite(data[step, 0].poses).all()


@pytest.mark.parametrize("sides", [(1, 1), (1, 3), (2, 2)])
def test_plans_hold_the_truth(model: DeepPointMap2, packed: Path, sides: tuple[int, int]) -> None:
    """Members moved to the first of their side, and one side moved to the other, coincide in the world."""
    settings = DataSettings(packed={str(packed): 1.0}, groups=2, frames=4, workers=0)
    batch = GroupDataset(settings, model.settings, settings.draw, 0)[0, 0]
    plan = sample_set_pairs(batch.poses, 2, sides, 20.0, torch.Generator().manual_seed(0))
    flat = batch.poses.flatten(0, 1).float()
    for row in range(4):
        members = torch.cat([plan.source[row], plan.target[row]])
        assert len(set((members // 4).tolist())) == 1  # one place
        assert len(set(members.tolist())) == sum(sides)
        first_source, first_target = flat[plan.source[row, 0]], flat[plan.target[row, 0]]
        torch.testing.assert_close(first_target @ plan.T_target_source[row], first_source, atol=1e-3, rtol=0)
        for k in range(sides[1]):
            torch.testing.assert_close(
                first_target @ plan.T_target[row, k], flat[plan.target[row, k]], atol=1e-3, rtol=0
            )
    tokens = model.encoder(batch.points).tokens
    merged = merge_tokens(tokens, plan.target, plan.T_target, True)
    assert merged.xyz.shape == (4, 48 * sides[1], 3)
    torch.testing.assert_close(merged.axis.norm(dim=-1), torch.ones(4, 48 * sides[1]))


@pytest.mark.parametrize("view_aligned", [True, False])
def test_merged_sets_have_the_same_axes_in_training_and_in_use(view_aligned: bool) -> None:
    """Offsets are trained in the axes in which the decoder reads them: rotated with the member, or those of the set."""
    noise = np.random.default_rng(0)
    axes = noise.normal(size=(2, 5, 2))
    axes = (axes / np.linalg.norm(axes, axis=-1, keepdims=True)).astype(np.float32)
    xyz, features = noise.normal(size=(2, 5, 3)).astype(np.float32), np.zeros((2, 5, 4), np.float32)
    members = [replace(Descriptors.of(x, f), axis=a) for x, f, a in zip(xyz, features, axes, strict=True)]
    T = np.stack([np.eye(4), se3.exp([0, 0, 1.2, 3, -1, 0])])
    used = to_tokens([merge([m.moved(t) for m, t in zip(members, T, strict=True)])], view_aligned)
    tokens = to_tokens(members, view_aligned)
    with torch.autocast("cpu", torch.bfloat16):
        trained = merge_tokens(tokens, torch.tensor([[0, 1]]), torch.from_numpy(T).float()[None], view_aligned)
    torch.testing.assert_close(trained.xyz, used.xyz)
    torch.testing.assert_close(trained.axis, used.axis)
