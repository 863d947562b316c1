# SPDX-License-Identifier: Apache-2.0
"""One set of error figures for every trajectory that this project evaluates, with one definition each.

All compare the poses of the same sensor frame; the alignment of the two world frames is stated with each figure.
`evo` computes the same APE and RPE and is the oracle of the tests, but is under the GPL and so not a dependency.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from dpm2_core.data.trajectory import Keys, frame_period, stamps_of
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS, SegmentErrors, known, relative, segment_errors
from dpm2_core.frame import Array
from dpm2_core.geometry import se3


class LengthErrors(BaseModel):
    """The KITTI metric of one segment length."""

    model_config = ConfigDict(frozen=True)

    length_m: float
    segments: int
    t_err_percent: float | None
    r_err_deg_per_100m: float | None


class SpeedErrors(BaseModel):
    """The KITTI metric of the segments driven at a speed within `speed_mps` +- half a step."""

    model_config = ConfigDict(frozen=True)

    speed_mps: float
    segments: int
    t_err_percent: float | None
    r_err_deg_per_100m: float | None


SPEED_STEP = 2.0
"""Width of a speed class, m/s: the development kit, too, has a value every 2 m/s, but with twice the width."""


class Metrics(BaseModel):
    """The figures of one run; None if the drive or the ground truth does not allow them."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    truth: str | None = None
    """Source of the true poses: a file or a topic; None if it is not known."""
    frames: int
    """Frames of the drive."""
    compared: int | None = None
    """Poses with ground truth: the errors are of these. Fewer than `frames` if the ground truth has a lower rate, or is
    of a part of the drive; None if it is not known."""
    failed_frames: int
    """Frames without an estimate of their own: missing, or only predicted."""
    breaks: int = 0
    """Pauses across which the motion is not known: the poses after a pause continue from a guess."""
    fps: float | None = None
    """Frames per second of processing, reading excluded; None if it is not known."""
    path_length_m: float | None = None
    """Length of the ground truth, m."""
    t_err_percent: float | None = None
    """KITTI metric, translation: mean over all segments of `lengths_m`, percent. None: shorter than every length."""
    r_err_deg_per_100m: float | None = None
    """KITTI metric, rotation, degrees per 100 m."""
    lengths_m: tuple[float, ...] = OFFICIAL_LENGTHS
    """Segment lengths of the KITTI metric; the benchmark's are 100 to 800 m."""
    segments: int = 0
    """Segments that the KITTI metric averages over."""
    per_length: tuple[LengthErrors, ...] = ()
    """The KITTI metric by segment length."""
    per_speed: tuple[SpeedErrors, ...] = ()
    """The KITTI metric by mean speed of the segments; speeds that none has are left out."""
    ape_rmse_m: float | None = None
    """Root mean square position error after the best SE(3) alignment (Umeyama, without scale), m."""
    ape_mean_m: float | None = None
    """Mean position error after the same alignment, m."""
    rpe_trans_m: float | None = None
    """Mean error of the translation from one frame to the next, m."""
    rpe_rot_deg: float | None = None
    """Mean error of the rotation from one frame to the next, degrees."""
    final_drift_percent: float | None = None
    """Position error at the last frame, aligned only at the first pose, over the length of the path, percent."""


def evaluate(
    gt: Array,
    est: Array,
    lengths: Sequence[float] = OFFICIAL_LENGTHS,
    *,
    stamps: Keys | None = None,
    failed_frames: int | None = None,
) -> Metrics:
    """Evaluate (N, 4, 4) poses against (N, 4, 4) ground truth of the same frames. Figures that these do not contain, as
    breaks and speed, are left to the caller.

    Args:
        gt: rows of NaN where the ground truth is unknown; these frames are left out.
        est: in the sensor frame of `gt` (the world frames may differ); rows of NaN where there is no estimate.
        lengths: of the KITTI metric's segments, m.
        stamps: (N,) ns, for the speeds and to find consecutive frames; by default KITTI's period apart.
        failed_frames: as counted by the SLAM system; by default the frames without an estimate.

    Raises:
        UsageError: the two differ in length or have another shape, or fewer than two frames have both poses.
    """
    if len(gt) != len(est):
        raise UsageError(f"ground truth has {len(gt)} poses, the estimate {len(est)}")
    if not np.shape(gt)[1:] == np.shape(est)[1:] == (4, 4):
        raise UsageError(f"ground truth of shape {np.shape(gt)}, estimate of {np.shape(est)}; want (N, 4, 4)")
    has_gt, has_est = known(gt), known(est)
    both = has_gt & has_est
    if both.sum() < 2:
        raise UsageError(
            f"only {both.sum()} of {len(gt)} frames have both an estimate and ground truth; want 2 or more"
        )
    segments = segment_errors(gt, est, lengths, stamps)
    rpe_trans, rpe_rot = rpe(gt, est, stamps)
    position = _position_errors(gt[both], est[both])
    return Metrics(
        frames=len(est),
        compared=int(both.sum()),
        failed_frames=int((~has_est).sum()) if failed_frames is None else failed_frames,
        path_length_m=path_length(gt[has_gt]),
        **_kitti_figures(segments),
        lengths_m=tuple(lengths),
        per_length=tuple(
            LengthErrors(length_m=length, **_kitti_figures(segments.where(segments.length == length)))
            for length in lengths
        ),
        per_speed=_by_speed(segments),
        ape_rmse_m=_rms(position),
        ape_mean_m=float(position.mean()),
        rpe_trans_m=rpe_trans,
        rpe_rot_deg=rpe_rot,
        final_drift_percent=final_drift_percent(gt[both], est[both]),
    )


def align(source: Array, target: Array) -> Array:
    """T_target_source (4, 4) that brings (N, 3) positions closest to (N, 3) others in the least squares sense.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
    """
    source_mean, target_mean = source.mean(0), target.mean(0)
    U, _, Vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    return se3.make(U @ Vt, target_mean - U @ Vt @ source_mean)


def have_other_axes(gt: Array, est: Array) -> bool:
    """Whether two trajectories (N, 4, 4) agree, but along other axes: of LiDAR and camera, or without rotations.

    Then the alignment of the first pose rotates the trajectory away from the alignment of all positions: by 0.3 of its
    extent (17 degrees) or more, far more than the error of an odometry whose trajectory fits to a tenth.
    """
    T_gt_est = align(est[:, :3, 3], gt[:, :3, 3])
    R_difference = gt[0, :3, :3] @ est[0, :3, :3].T - T_gt_est[:3, :3]
    centered = est[:, :3, 3] - est[:, :3, 3].mean(0)
    extent = _rms(np.linalg.norm(centered, axis=1))
    return ape_rmse(gt, est) < 0.1 * extent and _rms(np.linalg.norm(centered @ R_difference.T, axis=1)) > 0.3 * extent


def ape_rmse(gt: Array, est: Array) -> float:
    """Root mean square position error, m, of (N, 4, 4) poses after alignment of all positions."""
    return _rms(_position_errors(gt, est))


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))


def _position_errors(gt: Array, est: Array) -> Array:
    """(N,) position errors, m, of (N, 4, 4) poses after alignment of all positions."""
    T_gt_est = align(est[:, :3, 3], gt[:, :3, 3])
    return np.asarray(np.linalg.norm((T_gt_est @ est)[:, :3, 3] - gt[:, :3, 3], axis=1))


def rpe(gt: Array, est: Array, stamps: Keys | None = None) -> tuple[float | None, float | None]:
    """Mean error from one frame to the next: translation m, rotation degrees; None without two known neighbors.

    Steps across missing frames, of more than 1.5 periods of the `stamps` (N,) ns, are left out.
    """
    stamps = stamps_of(np.arange(len(gt))) if stamps is None else stamps
    both = known(gt) & known(est)
    is_consecutive = np.diff(stamps) <= 1.5e9 * frame_period(stamps)
    first = np.flatnonzero(both[:-1] & both[1:] & is_consecutive)
    if not len(first):
        return None, None
    error = se3.inverse(relative(gt, first, first + 1)) @ relative(est, first, first + 1)
    return float(np.linalg.norm(error[:, :3, 3], axis=1).mean()), float(np.degrees(se3.angle(error)).mean())


def final_drift_percent(gt: Array, est: Array) -> float | None:
    """Position error at the end of (N, 4, 4) poses, aligned at the first, over the path length; None without motion."""
    length = path_length(gt)
    end = (gt[0] @ se3.inverse(est[0]) @ est[-1])[:3, 3] - gt[-1, :3, 3]
    return 100 * float(np.linalg.norm(end)) / length if length > 0 else None


def path_length(poses: Array) -> float:
    """Length of the path through (N, 4, 4) poses, m."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def _by_speed(segments: SegmentErrors) -> tuple[SpeedErrors, ...]:
    step = np.floor(segments.speed / SPEED_STEP + 0.5)
    by_step = ((k, segments.where(step == k)) for k in np.unique(step[np.isfinite(step)]).tolist())
    return tuple(SpeedErrors(speed_mps=k * SPEED_STEP, **_kitti_figures(chosen)) for k, chosen in by_step)


def _kitti_figures(segments: SegmentErrors) -> dict[str, Any]:
    """The KITTI metric of some segments, under the names that all models here use."""
    mean = segments.mean()
    t_err, r_err = (None, None) if mean is None else (100 * mean[0], 100 * float(np.degrees(mean[1])))
    return {"segments": len(segments), "t_err_percent": t_err, "r_err_deg_per_100m": r_err}
