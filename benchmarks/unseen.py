# SPDX-License-Identifier: Apache-2.0
"""The network on synthetic worlds that were used neither in training nor in the choice of the checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.geometric import BASELINE
from benchmarks.harness import Options, installed, settings_of
from benchmarks.pairs import MANY, PairMethod, by_registration, kiss_from_identity, summarized
from dpm2_core.data.corrupt import hidden_by, random_box
from dpm2_core.data.packed import PackedDrive, Sample
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.pair_set import FAR, NEAR, PairSet
from dpm2_core.frame import Array, Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.learning.generate import GenerateSettings, generate
from dpm2_core.learning.train_overlap import FRAMES, OVERLAP, average_precision, draw_overlap
from dpm2_core.network.images import in_encoded_axes
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.sim.settings import PresetName
from dpm2_core.slam.build import make_registration

# Training begins at seed 1,000, validation at 900,000.
_SEEDS = {"mixed": 910_000, "highway": 920_000, "tunnel": 930_000}
_WORLDS = {"mixed": 8, "highway": 2, "tunnel": 2}
_FRAMES = 24
_NO_CAMERA = "not answered: these weights have no camera"
_MIN_POINTS = 128  # least number of points that remain of an obstructed scan


def unseen_drives(network: DeepPointMap2, options: Options, kind: str = "mixed") -> Path:
    """Folder of packed drives: those that were given, or new ones, which later runs reuse."""
    if options.unseen is not None:
        named = options.unseen / kind
        return named if named.is_dir() else options.unseen
    camera = network.encoder.image is not None
    root = options.cache / f"{network.settings.preset}_{'camera' if camera else 'lidar'}" / kind
    mixture: dict[PresetName, float] = {} if kind == "mixed" else {kind: 1.0}  # type: ignore[dict-item]
    settings = GenerateSettings(worlds=_WORLDS[kind], first_seed=_SEEDS[kind], frames=_FRAMES)
    changes: dict[str, Any] = {
        "images": camera,
        "preset": network.settings.preset,
        "mixture": mixture or settings.mixture,
    }
    generate(root, settings.model_copy(update=changes), options.threads)
    return root


def synthetic(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Pairs up to 5, 20 and 50 m apart, straight and with any yaw; highways and tunnels apart, see `image_matters`."""
    pairs = _pairs(network, options, "mixed", 2 * options.pairs)
    rows = pairs.errors(network)
    near, is_turned = rows[:, 0] <= NEAR, rows[:, 1] > 0
    drive_of = {i: pairs.drives[key[0]] for key, i in pairs.frames.items()}
    has_structure = np.array(
        [drive_of[pair[0]].about.get("preset") not in ("highway", "tunnel") for pair in pairs.pairs]
    )
    kinds = {
        "up to 5 m": near & ~is_turned & has_structure,
        "up to 20 m": ~is_turned & has_structure,
        "up to 5 m, any yaw": near & is_turned & has_structure,
        "up to 20 m, any yaw": is_turned & has_structure,
        "up to 20 m, highway and tunnel": ~has_structure,
    }
    is_right = rows[:, 2] < 0.6
    found = {kind: {"neural": summarized(rows[chosen, 2:4])} for kind, chosen in kinds.items()}
    for low, high in ((20, 30), (30, 50)):
        farther = _pairs(network, options, "mixed", 4 * options.pairs, high).errors(network)
        found[f"{low} to {high} m, any yaw"] = {"neural": summarized(farther[farther[:, 0] > low, 2:4])}
    return {
        "pairs": found,
        # With 6 degrees of freedom a median of 5.35 would mean that the covariance is exactly right.
        "median_chi2": float(np.median(rows[is_right, 4])) if is_right.any() else None,
    }


class _ChangedDrive:
    """A packed drive whose samples are changed as they are read."""

    def __init__(self, drive: PackedDrive, change: Callable[[Sample, int], Sample]) -> None:
        self._drive, self._change, self.poses, self.about = drive, change, drive.poses, drive.about

    def __len__(self) -> int:
        return len(self._drive)

    def __getitem__(self, index: int) -> Sample:
        return self._change(self._drive[index], index)


def blackened(sample: Sample, index: int) -> Sample:
    """The sample with black images, as from a failed camera."""
    return sample._replace(images=tuple(Image(np.zeros_like(i.pixels), i.camera) for i in sample.images))


def obstructed(sample: Sample, index: int) -> Sample:
    """The sample without the points behind a box near the sensor, different for each frame."""
    hidden = hidden_by(random_box(np.random.default_rng([index, 5])), sample.cloud)
    return sample if (~hidden).sum() < _MIN_POINTS else sample._replace(cloud=sample.cloud[~hidden])


def corruption(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Every frame with a black image, or every frame with a box in front of the LiDAR, on the same pairs as clean."""
    camera = network.encoder.image is not None
    rows = {"clean": _pairs(network, options, "mixed", options.pairs).errors(network)}
    changes = {"LiDAR obstruction 100 %": obstructed, **({"camera failure 100 %": blackened} if camera else {})}
    for name, change in changes.items():
        pairs = _pairs(network, options, "mixed", options.pairs)
        pairs.drives = [_ChangedDrive(drive, change) for drive in pairs.drives]  # type: ignore[misc]
        rows[name] = pairs.errors(network)
    out: dict[str, Any] = {"pairs": {name: {"neural": summarized(found[:, 2:4])} for name, found in rows.items()}}
    clean = np.median(rows["clean"][:, 2])
    out["error_ratio"] = {n: float(np.median(found[:, 2]) / clean) for n, found in rows.items() if n != "clean"}
    if not camera:
        out["camera failure 100 %"] = _NO_CAMERA
    return out


def image_matters(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Highway and tunnel, whose geometry does not constrain the motion: with the camera, without, and KISS-ICP.

    `descriptors` is the network alone; `neural` and `refined` are the SLAM's registrations, including the image along
    the open direction.
    """
    camera = network.encoder.image is not None
    peers = installed({BASELINE: partial(kiss_from_identity, options.threads)})
    out: dict[str, Any] = {"pairs": {}}
    for kind in ("highway", "tunnel"):
        pairs = _pairs(network, options, kind, options.pairs)
        methods: dict[str, Array] = {}
        for images in (True, False) if camera else (False,):
            pairs.images = images
            label = "with camera" if images else "without camera"
            methods[f"descriptors {label}"] = pairs.errors(network)[:, [0, 2, 3]]
            for name in ("neural", "refined"):
                registered = by_registration(make_registration(settings_of(options, f"slam.registration={name}")))
                methods[f"{name} {label}"] = _near_errors(pairs, registered)
        methods |= {name: _near_errors(pairs, register) for name, register in peers.items()}
        near = methods["descriptors without camera"][:, 0] <= NEAR
        out["pairs"][f"{kind}, up to 5 m"] = {name: summarized(rows[near, 1:]) for name, rows in methods.items()}
    if not camera:
        out["with the camera"] = _NO_CAMERA
    return out


def _near_errors(pairs: PairSet, register: PairMethod) -> Array:
    """(pairs, 3) distance m, translation error m, rotation error deg; infinite without a result and for far pairs."""
    frames = {i: _turned_frame(pairs, key, i) for key, i in pairs.frames.items()}
    rows = []
    for source, target, T, distance in pairs.pairs:
        found = register(frames[target], frames[source]) if distance <= NEAR else None
        error = (np.inf, np.inf) if found is None else se3.apart(T, found)
        rows.append((distance, *error))
    return np.array(rows)


def _turned_frame(pairs: PairSet, key: tuple[int, int, float], number: int) -> Frame:
    """The frame of a pair as `PairSet` passes it to the network."""
    drive, index, yaw = key
    T_yaw, sample = se3.exp([0, 0, yaw, 0, 0, 0]), pairs.drives[drive][index]
    cloud = se3.transform(T_yaw, sample.cloud)
    images = tuple(in_encoded_axes(image, T_yaw[:3, :3], 1.0) for image in sample.images if pairs.images)
    return Frame(number, np.c_[cloud, np.zeros(len(cloud))].astype(np.float32), images=images, index=number)


def overlap(network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Average precision of the overlap head: half of the pairs within 20 m, a quarter 20-40 m, a quarter farther.

    Raises:
        UsageError: the head is untrained.
    """
    if not network.decoder.overlap_trained:
        raise UsageError("overlap: the head of these weights is untrained; dpm2 train phase2 trains it")
    pairs = _pairs(network, options, "mixed", 1)
    noise = np.random.default_rng(3)
    groups = max(1, MANY * options.pairs // (FRAMES - 1))
    pairs.frames, chosen, distances = {}, [], []
    for g in range(groups):
        d = g % len(pairs.drives)
        poses = pairs.drives[d].poses
        index = draw_overlap(poses, noise)
        rows = [pairs.frames.setdefault((d, int(i), 0.0), len(pairs.frames)) for i in index]
        chosen += [(rows[0], row) for row in rows[1:]]
        distances += np.linalg.norm(poses[index[1:], :3, 3] - poses[index[0], :3, 3], axis=1).tolist()
    descriptors = pairs.encode(network)
    scores: list[float] = []
    for at in range(0, len(chosen), 32):
        part = chosen[at : at + 32]
        results = network.register_many([descriptors[a] for a, _ in part], [descriptors[b] for _, b in part])
        scores += [result.overlap for result in results]
    near = np.array(distances) <= OVERLAP
    hard = (np.array(distances) > OVERLAP) & (np.array(distances) <= 40)
    return {
        "average_precision": average_precision(np.array(scores), near),
        "pairs": len(scores),
        "positive": int(near.sum()),
        "negative_20_40_m": int(hard.sum()),
    }


def _pairs(network: DeepPointMap2, options: Options, kind: str, count: int, farthest: float = FAR) -> PairSet:
    images = network.encoder.image is not None
    return PairSet(unseen_drives(network, options, kind), count, network.settings, images, farthest)
