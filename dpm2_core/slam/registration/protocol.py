# SPDX-License-Identifier: Apache-2.0
"""How a scan finds its pose: the part of the odometry that can be exchanged, and what it is told beforehand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from dpm2_core.estimates import Registration, isotropic
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.swept import Beginning, Swept

_EXPECTED = (0.3, 2.0)  # m and degrees from the prediction; hard braking makes 0.1 m in 0.1 s
_EXACT = 0.1  # m
_NEARLY_ALL = 0.9  # confidence
_BETTER = 0.02  # confidence: so much more of the points must fit where the motion or the stamp did not lead
CHI2, CHI2_95 = 22.46, 12.59
"""99.9 and 95 % quantile of chi2 with 6 degrees of freedom: two poses that are farther apart than the first contradict
each other, farther than the second hardly agree."""

# What the covariances of two registrations leave out, rad and m: the poses of the frames that make up the maps.
MAP_NOISE = isotropic(np.radians(0.1), 0.03)


def agree(a: Registration, b: Registration, most: float = CHI2) -> bool:
    """Whether two results may be one pose: xi^T (S_a + S_b + S_map)^-1 xi <= `most`, xi (6,) being their difference.

    Errors of calibration are the same in both.
    """
    covariance = a.of_scene + b.of_scene + MAP_NOISE
    return se3.squared_sigmas(a.T_target_source, b.T_target_source, covariance) <= most


def near(T: Array, T_other: Array, most: tuple[float, float] = _EXPECTED) -> bool:
    """Whether two poses (4, 4) are at most so far apart, m and degrees: by default, as a vehicle's motion changes from
    scan to scan."""
    meters, degrees = se3.apart(T, T_other)
    return meters <= most[0] and degrees <= most[1]


def fits_better(result: Registration, other: Registration) -> bool:
    """Whether one of two results for a scan is to be preferred to the other, from where it was expected."""
    return result.ok and (not other.ok or result.confidence > other.confidence + _BETTER)


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the motion so far says about the pose of a scan.

    Attributes:
        starts: (4, 4) T_odom_lidar, the most likely first; several while the velocity is unknown.
        widen: factor on how far from them the pose is searched.
        information: (6, 6) [rotation rad, translation m] of the first; None: nothing to go by.
        unique: the starts are a search for a place: a result needs fewer points that fit, since a scan from afar shows
            much that the map does not have, but no other start may lead to a place that fits nearly as well. The
            network must be surer of its matches.
        possible: whether the robot can be at a pose (4, 4); asked of what is found without a start.
    """

    starts: Sequence[Array]
    widen: float = 1.0
    information: Array | None = None
    unique: bool = False
    possible: Callable[[Array], bool] = lambda _: True

    @property
    def known(self) -> bool:
        """Whether the motion so far leads to the place: to 1 m, standard deviation in the least certain direction.

        At the default steadiness that lasts 0.3 s.
        """
        return self.information is not None and float(np.linalg.eigvalsh(self.information[3:, 3:])[0]) >= 1.0

    def expects(self, T_odom_lidar: Array) -> bool:
        """Whether the motion so far leads to that pose (4, 4) itself: to one standard deviation, at most `_EXACT`."""
        if self.information is None or not self.known or not near(self.starts[0], T_odom_lidar):
            return False
        xi = se3.way(self.starts[0], T_odom_lidar)
        return bool(xi @ self.information @ xi <= 1.0 and np.linalg.norm(xi[3:]) <= _EXACT)

    def convinced(self, points: Registration) -> bool:
        """Whether a result of points fits well enough not to be doubted, if it leaves no direction open.

        Where the motion is not known more must fit: of 54 poses between the two values 3 were wrong, of 1,047 above 4
        (vehicles up to 0.9 s after the last scan, one at walking pace up to 2.5 s).
        """
        return points.ok and points.confidence >= (0.7 if self.known else 0.75)

    def strays(self, points: Registration) -> bool:
        """Whether a result of points lies beside where the motion leads, and not nearly all of them fit.

        After a jolt they may be at the wrong walls: after a turn of 10 degrees from scan to scan 77 % fitted, 2.6
        degrees off.
        """
        beside = self.known and not near(self.starts[0], points.T_target_source)
        return beside and points.confidence < _NEARLY_ALL


class ScanRegistration(Protocol):
    """Registers scans to what it remembers of earlier ones. T_target_source of its results is T_odom_lidar.

    Attributes:
        uses_images: whether frames should come with their images.
    """

    @property
    def uses_images(self) -> bool: ...

    def __len__(self) -> int:
        """0 while there is nothing to register to."""
        ...

    def fresh(self) -> Self:
        """Another one like it that remembers nothing yet."""
        ...

    def prepare(self, frame: Frame, motion: Array) -> Scan:
        """What it needs of a frame that was taken while moving so: `motion` (6,) [rad/s, m/s] or (K, 6), as
        `curve.poses` takes it; never raises."""
        ...

    def rejection(self, scan: Scan) -> str:
        """Why no map can begin with this scan; empty if one can."""
        ...

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        """Find the pose of a scan; needs a map."""
        ...

    def swept(self, scan: Scan, result: Registration, beginning: Beginning) -> Swept | None:
        """The motion during the sweep of a scan that was registered so; None: the scan does not show it."""
        ...

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        """Remember a scan that was taken there, if it shows enough that is new; whether it did."""
        ...
