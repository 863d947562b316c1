# SPDX-License-Identifier: Apache-2.0
"""Pairs of frames registered without any prior: errors of each method against the ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpm2_core.evaluation.pair_set import SUCCESS
from dpm2_core.experiments.peers import KissIcp, cloud_and_times
from dpm2_core.extras import needs
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.sampling import evenly
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration

APART = {f"{low}-{low + 10} m": (low, low + 10) for low in (10, 20, 30, 40)}
"""Distances of the far pairs, m, by name."""
MANY = 10
"""Factor on the number of pairs if no odometry is run for each: pairs of frames that are described anyway cost little,
and medians of 45 pairs differ by a third."""

PairMethod = Callable[[Frame, Frame], Array | None]
"""T_first_second (4, 4) of two frames; None: no result."""

Pairs = Sequence[tuple[int, int]]
FITTED = "neural, against fitted poses"
"""The errors of `neural` against poses corrected with the scans: see `fitted_poses`."""
_MAX_CORRECTION = 1.0, 3.0  # m, deg: a larger correction is a wrong match


def pairs_of(poses: Array, most: int) -> dict[str, list[tuple[int, int]]]:
    """Positions of pairs in a drive, at most `most` of each kind, evenly spread.

    Args:
        poses: (N, 4, 4) truth; pairs with an unknown pose are left out.
    """
    n, positions = len(poses), poses[:, :3, 3]
    kinds: dict[str, list[tuple[int, int]]] = {
        "consecutive": [(i, i + 1) for i in range(n - 1)],
        "8 apart": [(i, i + 8) for i in range(n - 8)],
    }
    for kind, (low, high) in APART.items():
        rng, kinds[kind] = np.random.default_rng(0), []
        for i in range(n):
            distance = np.linalg.norm(positions[i + 1 :] - positions[i], axis=1)
            candidates = np.flatnonzero((distance >= low) & (distance <= high))
            if len(candidates):
                kinds[kind].append((i, i + 1 + int(rng.choice(candidates))))
    known: NDArray[np.bool_] = np.isfinite(poses.sum((1, 2)))
    out = {}
    for kind, pairs in kinds.items():
        usable = [(a, b) for a, b in pairs if known[a] and known[b]]
        out[kind] = [usable[k] for k in evenly(len(usable), most).tolist()]
    return out


def by_registration(registration: ScanRegistration) -> Callable[..., Array | None]:
    """A `PairMethod`: the registration of the odometry, with a map of one frame. The prediction is the identity, or a
    third argument; each frame is prepared once."""
    prepared: dict[int, Scan] = {}

    def scan_of(frame: Frame) -> Scan:
        if frame.index not in prepared:
            prepared[frame.index] = registration.prepare(frame, np.zeros(6))
        return prepared[frame.index]

    def register(first: Frame, second: Frame, T_first_second: Array | None = None) -> Array | None:
        map_of_first = registration.fresh()
        map_of_first.update(scan_of(first), np.eye(4))
        start = Prediction([np.eye(4)], widen=2.0)
        if T_first_second is not None:
            start = Prediction([T_first_second], unique=True)  # at a distance fewer points of a scan fit
        result = map_of_first.register(scan_of(second), start)
        return result.T_target_source if result.ok else None

    return register


def gicp_from_identity(threads: int) -> PairMethod:
    """small_gicp's GICP of the two scans at 0.25 m, started at the identity with correspondences up to 2 m.

    Raises:
        MissingPackageError: it is not installed.
    """
    with needs("bench", "the peer small_gicp"):
        import small_gicp

    def register(first: Frame, second: Frame) -> Array:
        target, source = (cloud_and_times(frame)[0] for frame in (first, second))
        options = {"max_correspondence_distance": 2.0, "max_iterations": 50, "num_threads": threads}
        return np.asarray(small_gicp.align(target, source, **options).T_target_source)

    return register


def kiss_from_identity(threads: int) -> PairMethod:
    """KISS-ICP on a drive of two frames: without a known motion, it starts at the identity.

    Raises:
        MissingPackageError: it is not installed.
    """

    def register(first: Frame, second: Frame) -> Array:
        odometry = KissIcp(threads, deskew=False)
        odometry.add(first)
        odometry.add(second)
        return np.asarray(odometry.poses()[-1])

    KissIcp(threads, deskew=False)  # raises an error if it is not installed
    return register


def fitted_poses(registration: ScanRegistration, frames: Sequence[Frame], pairs: Pairs, poses: Array) -> list[Array]:
    """T_first_second (4, 4) of each pair by point-to-plane registration, started at the poses (N, 4, 4); if that fails,
    or leads too far away, the original pose.

    KITTI's poses have errors of centimeters, and of 1.7 degrees over a corner of 00. Registration benchmarks therefore
    correct them with the scans (C. Choy, J. Park, V. Koltun, "Fully Convolutional Geometric Features", ICCV 2019).
    """
    register, out = by_registration(registration), list[Array]()
    for a, b in pairs:
        T = se3.inverse(poses[a]) @ poses[b]
        found = register(frames[a], frames[b], T)
        is_near = found is not None and bool((np.array(se3.apart(T, found)) < _MAX_CORRECTION).all())
        out.append(found if found is not None and is_near else T)
    return out


def pair_errors(found: Sequence[Array | None], truth: Sequence[Array | None]) -> Array:
    """(len(found), 2) distance, m, and angle, deg, between poses and other poses; inf if one is missing."""
    errors = np.full((len(found), 2), np.inf)
    for row, T, other in zip(errors, found, truth, strict=True):
        if T is not None and other is not None:
            row[:] = se3.apart(other, T)
    return errors


def summarized(errors: Array) -> dict[str, float | int | None]:
    """Median errors and success rate of (N, 2) errors, m and deg; None if undefined."""
    if not len(errors):
        return {"pairs": 0, "median_m": None, "median_deg": None, "success": None}
    median = np.median(errors, axis=0)
    succeeded = (errors < SUCCESS).all(1)
    m, deg = (float(value) if np.isfinite(value) else None for value in median)
    return {"pairs": len(errors), "median_m": m, "median_deg": deg, "success": float(succeeded.mean())}


def all_pairs(
    kinds: Mapping[str, Mapping[str, PairMethod]],
    frames: Sequence[Frame],
    poses: Array,
    most: int,
    points: ScanRegistration,
) -> dict[str, dict[str, Any]]:
    """Each kind of pair, at most `most` of it, with its methods; `neural` also against poses fitted by `points`."""
    out: dict[str, dict[str, Any]] = {}
    for kind, pairs in pairs_of(poses, most).items():
        truth = [se3.inverse(poses[a]) @ poses[b] for a, b in pairs]
        found = {name: [method(frames[a], frames[b]) for a, b in pairs] for name, method in kinds[kind].items()}
        out[kind] = {name: summarized(pair_errors(T, truth)) for name, T in found.items()}
        if "neural" in found:
            fitted = fitted_poses(points, frames, pairs, poses)
            out[kind][FITTED] = summarized(pair_errors(found["neural"], fitted))
    return out
