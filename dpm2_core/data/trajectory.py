# SPDX-License-Identifier: Apache-2.0
"""Trajectory files, KITTI and TUM, and the association of the poses of two trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpm2_core.data.text import MAX_NUMBER, read_lines
from dpm2_core.errors import UsageError
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

Keys = NDArray[np.int64]

_TUM, _KITTI, _KITTI_INDEXED, _KITTI_360 = 8, 12, 13, 17  # numbers per line
_MAX_GAP = 1_000_000_000  # ns between two poses beyond which no pose is interpolated
FRAME_PERIOD = 0.1
"""Period of KITTI's scans, s."""
_MAX_STAMP_ERROR = 100_000  # ns between the stamps of a frame in two files: stamps of four decimals; 3 mm at 30 m/s
_LOWER_RATE_RATIO = 0.75  # ratio of two periods; below it the rates differ by more than single lost frames and jitter


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses and their keys.

    Attributes:
        poses: (N, 4, 4) float64 T_world_sensor, m.
        keys: (N,) int64: stamps in ns (TUM) or frame numbers (KITTI; the line number from 0 if no index is given).
        kind: "tum", "kitti", or "kitti-indexed" if the first of 13 columns is the frame number.
    """

    poses: Array
    keys: Keys
    kind: str

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def period(self) -> float:
        """Median time between consecutive poses, s; that of KITTI's frames if there are no stamps."""
        return frame_period(self.keys) if self.kind == "tum" else FRAME_PERIOD


def write_kitti(path: Path | str, poses: Array) -> None:
    """Write (N, 4, 4) poses as 12 numbers per line, row-major."""
    with atomic_write(path) as file:
        np.savetxt(file, np.asarray(poses, np.float64)[:, :3].reshape(-1, 12), "%.12e")


def write_tum(path: Path | str, stamps: Sequence[int] | Keys, poses: Array) -> None:
    """Write `stamp x y z qx qy qz qw` per line; stamps in ns become seconds with nine decimals, which a float loses."""
    poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    numbers = np.hstack([poses[:, :3, 3], se3.quaternion(poses)])
    with atomic_write(path) as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for stamp, row in zip(stamps, numbers, strict=True):
            sign, ns = "-" if stamp < 0 else "", abs(int(stamp))
            file.write(f"{sign}{ns // 10**9}.{ns % 10**9:09d} " + " ".join(f"{x:.12g}" for x in row) + "\n")


def read_trajectory(path: Path | str, allow_empty: bool = False) -> Trajectory:
    """Read KITTI (12 numbers per line, or 13 with the frame number first), KITTI-360 (also 17) or TUM (8).

    Args:
        allow_empty: a file without a pose is read as an empty TUM trajectory.

    Raises:
        UsageError: no such file, or a line that is not a pose; the message names file and line.
    """
    lines = [(number, line.split()) for number, line in enumerate(read_lines(Path(path), missing_ok=False), 1)]
    lines = [(number, fields) for number, fields in lines if fields and not fields[0].startswith("#")]
    if not lines and allow_empty:
        return Trajectory(np.zeros((0, 4, 4)), np.zeros(0, np.int64), "tum")
    if not lines:
        raise UsageError(f"{path}: holds no pose")
    columns = len(lines[0][1])
    if columns not in (_TUM, _KITTI, _KITTI_INDEXED, _KITTI_360):
        raise UsageError(f"{path}:{lines[0][0]}: {columns} numbers; want 8 (TUM), 12 or 13 (KITTI) or 17 (KITTI-360)")
    keys: list[int] = []
    rows: list[list[float]] = []
    for number, fields in lines:
        if len(fields) != columns:
            raise UsageError(f"{path}:{number}: {len(fields)} numbers where the lines before have {columns}")
        try:
            rows.append([float(field) for field in fields])
            keys.append(_parse_key(fields[0], columns) if columns != _KITTI else len(keys))
        except ValueError as error:
            raise UsageError(f"{path}:{number}: {error}") from None
    numbers = np.array(rows)
    poses, valid = _poses(numbers, columns)
    if not valid.all():
        hint = " (is it transposed?)" if columns == _KITTI_360 else ""
        raise UsageError(f"{path}:{lines[int(np.argmin(valid))][0]}: not a finite rigid transform{hint}")
    if columns in (_KITTI_INDEXED, _KITTI_360) and len(set(keys)) < len(keys):
        raise UsageError(f"{path}: the frame numbers of its first column repeat")
    kind = {_TUM: "tum", _KITTI: "kitti"}.get(columns, "kitti-indexed")
    return Trajectory(poses, np.array(keys, np.int64), kind)


def _parse_key(field: str, columns: int) -> int:
    """A TUM stamp in ns, exact where a float would lose the last digits, or a frame number."""
    value = Decimal(field) * (10**9 if columns == _TUM else 1)
    if not value.is_finite() or abs(value) > 2**62 or (columns != _TUM and value != int(value)):
        raise ValueError(f"{field} is not a {'time stamp' if columns == _TUM else 'frame number'}")
    return round(value)


def _poses(rows: Array, columns: int) -> tuple[Array, NDArray[np.bool_]]:
    """(N, columns) numbers to (N, 4, 4) poses, and which of them are finite rigid transforms."""
    finite = np.logical_and.reduce(np.abs(rows) <= MAX_NUMBER, axis=1)  # also rejects NaN
    rows = np.where(finite[:, None], rows, 0.0)
    if columns == _TUM:
        quaternions = rows[:, 4:8]
        valid = finite & (np.abs(np.linalg.norm(quaternions, axis=1) - 1) < 0.01)
        quaternions = np.where(valid[:, None], quaternions, [0.0, 0.0, 0.0, 1.0])
        return se3.make(Rotation.from_quat(quaternions).as_matrix(), rows[:, 1:4]), valid
    if columns == _KITTI_360:  # the frame number and all 16 numbers of a 4 x 4 matrix
        finite &= np.abs(rows[:, 13:] - [0, 0, 0, 1]).max(1) < 0.01
        rows = rows[:, :_KITTI_INDEXED]
    matrices = rows[:, -12:].reshape(-1, 3, 4)
    R = matrices[:, :, :3]
    # Published files have 5 to 7 digits; 0.01 separates rounding from a matrix that is no rotation.
    skew = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max((1, 2))
    return se3.make(R, matrices[:, :, 3]), finite & (skew < 0.01) & (np.linalg.det(R) > 0)


def matched(gt: Trajectory, est: Trajectory) -> tuple[Array, Array, Keys]:
    """Ground truth and estimate (N, 4, 4) of the same frames, NaN where either has none, and their keys (N,): stamps,
    ns, if one of the two is TUM, else frame numbers.

    If both are TUM and their stamps differ, one is interpolated: the ground truth at the stamps of the estimate, or the
    estimate if the ground truth has a clearly lower rate. Else poses are associated by stamp, by frame number if one
    has it and the other has a line for each number, else line by line.

    Raises:
        UsageError: the association of the poses is not defined, or no poses match.
    """
    stamped = gt.kind == est.kind == "tum"
    numbered = "tum" not in (gt.kind, est.kind) and "kitti-indexed" in (gt.kind, est.kind)
    for lines, other in ((est, gt), (gt, est)):
        if numbered and lines.kind == "kitti" and len(lines) <= other.keys.max():  # only some frames: no line numbers
            numbered = False
    if not stamped and not numbered:
        if len(gt) == len(est):
            return gt.poses, est.poses, (est if est.kind == "tum" or gt.kind == "kitti" else gt).keys
        raise UsageError(
            f"ground truth has {len(gt)} poses ({gt.kind}), the estimate {len(est)} ({est.kind}), and neither frame"
            " numbers (13 KITTI columns, the number first) nor stamps (both TUM) show which ones correspond;"
            " stamps do, as for the trajectory.tum of `dpm2 run` against a drive (`dpm2 eval --gt DRIVE`) or a TUM file"
        )
    gt, est = _ordered(gt), _ordered(est)
    if stamped and not (same_stamps(gt.keys, est.keys) and gt.period >= _LOWER_RATE_RATIO * est.period):
        return _interpolated(gt, est)
    est_poses = placed(est, gt.keys)
    if not np.isfinite(est_poses).any():
        numbers = f"({est.keys[0]}...) is one of the ground truth ({gt.keys[0]}...)"
        raise UsageError(f"no frame number of the estimate {numbers}")
    return gt.poses, est_poses, gt.keys


def placed(trajectory: Trajectory, keys: Keys) -> Array:
    """Poses (N, 4, 4) at `keys` (N,); NaN if there is none with that frame number, or with a stamp within a quarter of
    a period. A pose whose stamp differs by more than rounding, as from another clock, is moved along the trajectory."""
    trajectory = _ordered(trajectory)
    rows, difference = _nearest(trajectory.keys, keys)
    near = difference <= (_MAX_STAMP_ERROR if trajectory.kind == "tum" else 0)
    poses = np.full((len(keys), 4, 4), np.nan)
    poses[near] = trajectory.poses[rows[near]]
    if trajectory.kind == "tum" and len(trajectory) > 1:
        nearby = ~near & (difference < 0.25e9 * min(trajectory.period, frame_period(np.sort(keys))))
        left = np.clip(np.searchsorted(trajectory.keys, keys[nearby]) - 1, 0, len(trajectory) - 2)
        # Next to a gap, the segment before or after is used.
        gap = trajectory.keys[left + 1] - trajectory.keys[left] > _MAX_GAP
        left = np.where(gap, np.clip(2 * rows[nearby] - left - 1, 0, len(trajectory) - 2), left)
        begin, end = trajectory.keys[left], trajectory.keys[left + 1]
        fraction = (keys[nearby] - begin) / (end - begin)
        poses[nearby] = se3.interpolated(trajectory.poses[left], trajectory.poses[left + 1], fraction)
    return poses


def same_stamps(a: Keys, b: Keys) -> bool:
    """Whether (N,) and (M,) stamps, ns, are of the same frames: most of the smaller set are also in the other."""
    smaller, larger = sorted((np.unique(a), np.unique(b)), key=len)
    return bool(2 * np.count_nonzero(_nearest(larger, smaller)[1] <= _MAX_STAMP_ERROR) > len(smaller))


def _ordered(trajectory: Trajectory) -> Trajectory:
    """The trajectory with ascending keys; of equal keys (a loop) the first is kept."""
    keys, first = np.unique(trajectory.keys, return_index=True)
    return Trajectory(trajectory.poses[first], keys, trajectory.kind)


def _interpolated(gt: Trajectory, est: Trajectory) -> tuple[Array, Array, Keys]:
    """Both at the stamps of the estimate, or of the ground truth if that has a clearly lower rate: interpolating across
    a second of a curve would be inaccurate."""
    at = gt.keys if est.period < _LOWER_RATE_RATIO * gt.period else est.keys
    true, estimated = (interpolate(each.keys, each.poses, at) for each in (gt, est))
    if not np.isfinite(true + estimated).any():
        raise UsageError(
            f"the estimate (time stamps from {est.keys[0]} to {est.keys[-1]} ns) has no pose during the ground truth"
            f" ({gt.keys[0]} to {gt.keys[-1]} ns): none at one of its stamps or between two up to 1 s apart"
        )
    return true, estimated, at


def interpolate(stamps: Keys, poses: Array, at: Keys) -> Array:
    """Interpolate poses (M, 4, 4) with `stamps` (M,) ns at the times `at` (N,): exact at a stamp, else along the screw
    motion between the neighbors; NaN outside and in gaps beyond 1 s. Returns (N, 4, 4)."""
    out = np.full((len(at), 4, 4), np.nan)
    stamps, order = np.unique(stamps, return_index=True)
    if not len(stamps):
        return out
    poses = poses[order]
    left = np.clip(np.searchsorted(stamps, at, "right") - 1, 0, None)
    right = np.minimum(left + 1, len(stamps) - 1)
    gap = stamps[right] - stamps[left]
    known = stamps[left] == at
    out[known] = poses[left[known]]
    between = ~known & (at > stamps[left]) & (at < stamps[right]) & (gap <= _MAX_GAP)
    fraction = (at - stamps[left])[between] / gap[between]
    out[between] = se3.interpolated(poses[left[between]], poses[right[between]], fraction)
    return out


def stamps_of(numbers: Keys) -> Keys:
    """Stamps (N,) ns of KITTI frames with these numbers (N,)."""
    return numbers * round(FRAME_PERIOD * 1e9)


def arc_lengths(positions: Array) -> Array:
    """(N,) m: distance travelled along positions (N, 2+), from the first one."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def frame_period(stamps: Keys | Sequence[int]) -> float:
    """Median time between consecutive stamps (N,) ns, s; the period of KITTI's frames if there are too few."""
    return float(np.median(np.diff(np.asarray(stamps)))) * 1e-9 if len(stamps) > 1 else FRAME_PERIOD


def _nearest(keys: Keys, requested: Keys) -> tuple[NDArray[np.intp], Keys]:
    """Index of the nearest of ascending `keys` for each requested one, and its distance."""
    right = np.clip(np.searchsorted(keys, requested), 0, len(keys) - 1)
    left = np.maximum(right - 1, 0)
    rows = np.where(np.abs(keys[left] - requested) <= np.abs(keys[right] - requested), left, right)
    return rows, np.abs(keys[rows] - requested)
