# SPDX-License-Identifier: Apache-2.0
"""Two arms that differ in one thing, compared seed by seed: the gain by that thing, and its confidence interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from statistics import mean, stdev

from scipy.special import stdtrit


@dataclass(frozen=True)
class Gain:
    """Relative improvement, positive if the second arm is better.

    Attributes:
        mean: over the seeds. low, high: its 95 % interval by Student's t of the paired differences; None for one seed.
        better: seeds in which the second arm is better. seeds: their number.
    """

    mean: float
    low: float | None
    high: float | None
    better: int
    seeds: int

    def __str__(self) -> str:
        if self.low is None or self.high is None:
            return f"{self.mean:+.1%}, one seed"
        return f"{self.mean:+.1%} [{self.low:+.1%}, {self.high:+.1%}], {self.better} of {self.seeds} better"


def paired_gain(without: Sequence[float], with_: Sequence[float], lower_is_better: bool) -> Gain | None:
    """The gain of the second arm over the mean of the first; None if that mean is zero or there are no seeds.

    Args:
        without, with_: a figure of each seed, in the same order; a seed in which either is not finite is left out.
    """
    pairs = [pair for pair in zip(without, with_, strict=True) if all(map(isfinite, pair))]
    baseline = abs(mean(a for a, _ in pairs)) if pairs else 0.0
    if not baseline:
        return None
    sign = -1 if lower_is_better else 1
    gains = [sign * (b - a) / baseline for a, b in pairs]
    center, n = mean(gains), len(gains)
    half_width = float(stdtrit(n - 1, 0.975)) * stdev(gains) / n**0.5 if n > 1 else None
    low, high = (None, None) if half_width is None else (center - half_width, center + half_width)
    return Gain(center, low, high, sum(gain > 0 for gain in gains), n)
