# SPDX-License-Identifier: Apache-2.0
"""The KITTI odometry metric: relative error over segments of given length along the ground truth.

A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving?", CVPR 2012; agrees with the development kit's
`evaluate_odometry.cpp` to every digit it prints (test_kitti_metric.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.trajectory import Keys, arc_lengths, frame_period, stamps_of
from dpm2_core.frame import Array
from dpm2_core.geometry import se3

OFFICIAL_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Segment lengths of the benchmark, m."""


@dataclass(frozen=True, eq=False)
class SegmentErrors:
    """Errors, with one entry per segment.

    Attributes:
        length: (S,) m.
        t_err: (S,) error of the relative translation over the length, a ratio.
        r_err: (S,) error of the relative rotation over the length, rad/m.
        speed: (S,) mean speed, m/s; NaN where the stamps go back.
    """

    length: Array
    t_err: Array
    r_err: Array
    speed: Array

    def __len__(self) -> int:
        return len(self.length)

    def where(self, chosen: NDArray[np.bool_]) -> SegmentErrors:
        """The chosen (S,) segments."""
        return SegmentErrors(self.length[chosen], self.t_err[chosen], self.r_err[chosen], self.speed[chosen])

    def mean(self) -> tuple[float, float] | None:
        """(t_err, r_err) as in the benchmark's ranking; None if the drive is shorter than every length."""
        return (float(self.t_err.mean()), float(self.r_err.mean())) if len(self) else None


def in_words(lengths: Sequence[float]) -> str:
    """Segment lengths, m, as text."""
    return f"{', '.join(f'{length:g}' for length in lengths)} m"


def segment_errors(
    gt: Array, est: Array, lengths: Sequence[float] = OFFICIAL_LENGTHS, stamps: Keys | None = None
) -> SegmentErrors:
    """Compare (N, 4, 4) poses with (N, 4, 4) ground truth of the same frames and the same sensor frame.

    Args:
        gt: rows of NaN where the ground truth is unknown; these frames are used only for the speeds.
        est: rows of NaN where a frame has no estimate; segments that begin or end there are left out.
        lengths: m. With those of the benchmark a segment starts every 10 frames, as there, with others at each frame.
        stamps: (N,) ns, for the speeds; by default KITTI's period apart.
    """
    stamps = stamps_of(np.arange(len(gt))) if stamps is None else stamps
    frame_of = np.flatnonzero(known(gt))  # position of each true pose among the frames
    gt, est = gt[frame_of], est[frame_of]
    step = 10 if tuple(lengths) == OFFICIAL_LENGTHS else 1
    travelled = arc_lengths(gt[:, :3, 3])
    starts = np.arange(0, len(gt), step)
    first, length = starts.repeat(len(lengths)), np.tile(np.array(lengths, np.float64), len(starts))
    last = np.searchsorted(travelled, travelled[first] + length, side="right")  # the first frame beyond the length
    is_complete = last < len(gt)
    first, last, length = first[is_complete], last[is_complete], length[is_complete]
    both = known(est)[first] & known(est)[last]
    first, last, length = first[both], last[both], length[both]
    error = se3.inverse(relative(est, first, last)) @ relative(gt, first, last)
    # As in the development kit: to the end of the first frame beyond the length, whether that one is there or not.
    time, period = stamps - stamps[0], 1e9 * frame_period(stamps)
    end = (
        np.minimum(time[frame_of[last]], np.interp(travelled[first] + length, travelled, time[frame_of]) + period)
        + period
    )
    seconds = (end - time[frame_of[first]]) / 1e9
    speed = np.divide(length, seconds, out=np.full_like(length, np.nan), where=seconds > 0)
    return SegmentErrors(length, np.linalg.norm(error[:, :3, 3], axis=1) / length, se3.angle(error) / length, speed)


def known(poses: Array) -> NDArray[np.bool_]:
    """(N,) which of (N, 4, 4) poses are finite."""
    return np.logical_and.reduce(np.isfinite(poses), axis=(1, 2))


def relative(poses: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """T_first_last of (N, 4, 4) poses for (S,) index pairs."""
    return se3.inverse(poses[first]) @ poses[last]
