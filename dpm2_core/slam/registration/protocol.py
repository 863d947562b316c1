# SPDX-License-Identifier: Apache-2.0
"""Interface of a scan registration, the exchangeable part of the odometry, and the prediction that it receives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from dpm2_core.estimates import Registration, isotropic
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.swept import SweepPrior, Swept

_NEAR_LIMITS = (0.3, 2.0)  # m and degrees from the prediction; hard braking makes 0.1 m in 0.1 s
_EXACT_DISTANCE = 0.1  # m
_HIGH_CONFIDENCE = 0.9
_MIN_CONFIDENCE_GAIN = 0.02  # confidence: by this much more points must fit at a pose away from the predicted one
CHI2, CHI2_95 = 22.46, 12.59
"""99.9 and 95 % quantile of chi2 with 6 degrees of freedom: two poses that are farther apart than the first contradict
each other; if they are farther apart than the second, they hardly agree."""

# Error that the covariances of two registrations leave out, rad and m: that of the poses of the frames in the maps.
MAP_NOISE = isotropic(np.radians(0.1), 0.03)


def agree(a: Registration, b: Registration, most: float = CHI2) -> bool:
    """Whether two results may be the same pose: xi^T (S_a + S_b + S_map)^-1 xi <= `most`, difference xi (6,).

    Calibration errors are left out, since they are the same in both.
    """
    covariance = a.of_scene + b.of_scene + MAP_NOISE
    return se3.squared_sigmas(a.T_target_source, b.T_target_source, covariance) <= most


def near(T: Array, T_other: Array, most: tuple[float, float] = _NEAR_LIMITS) -> bool:
    """Whether two poses (4, 4) are within `most`, m and degrees; by default a vehicle's change between scans."""
    meters, degrees = se3.apart(T, T_other)
    return meters <= most[0] and degrees <= most[1]


def fits_better(result: Registration, other: Registration) -> bool:
    """Whether `result` is better than `other`, the result from the expected pose of the scan."""
    return result.ok and (not other.ok or result.confidence > other.confidence + _MIN_CONFIDENCE_GAIN)


@dataclass(frozen=True, eq=False)
class Prediction:
    """The pose of a scan as predicted from the motion so far.

    Attributes:
        starts: (4, 4) T_odom_lidar, the most likely first; several while the velocity is unknown.
        widen: factor on the search range around the starts.
        information: (6, 6) [rotation rad, translation m] of the first start; None: unknown.
        unique: the starts are a global search. A result then needs fewer points that fit, since a distant scan shows
            much that the map does not have, but no other start may lead to a pose that fits nearly as well. The network
            must have a higher confidence in its matches.
        possible: whether the robot can be at a pose (4, 4); called for poses found without a start.
    """

    starts: Sequence[Array]
    widen: float = 1.0
    information: Array | None = None
    unique: bool = False
    possible: Callable[[Array], bool] = lambda _: True

    @property
    def known(self) -> bool:
        """Whether the motion so far determines the position to 1 m, standard deviation in the worst direction.

        At the default steadiness that lasts 0.3 s.
        """
        return self.information is not None and float(np.linalg.eigvalsh(self.information[3:, 3:])[0]) >= 1.0

    def expects(self, T_odom_lidar: Array) -> bool:
        """Whether a pose (4, 4) is the predicted one: within one standard deviation and `_EXACT_DISTANCE`."""
        if self.information is None or not self.known or not near(self.starts[0], T_odom_lidar):
            return False
        xi = se3.way(self.starts[0], T_odom_lidar)
        return bool(xi @ self.information @ xi <= 1.0 and np.linalg.norm(xi[3:]) <= _EXACT_DISTANCE)

    def fits_well(self, points: Registration) -> bool:
        """Whether a point registration fits well enough to be accepted, if it leaves no direction unconstrained.

        With an unknown motion more points must fit: of 54 poses between the two values 3 were wrong, of 1,047 above 4
        (vehicles up to 0.9 s after the last scan, one at walking pace up to 2.5 s).
        """
        return points.ok and points.confidence >= (0.7 if self.known else 0.75)

    def is_stray(self, points: Registration) -> bool:
        """Whether a point registration is away from the predicted pose, and not nearly all of its points fit.

        After a jolt the points may be matched to the wrong walls: after a rotation of 10 degrees between scans 77 %
        fitted, at a pose that was 2.6 degrees off.
        """
        is_away = self.known and not near(self.starts[0], points.T_target_source)
        return is_away and points.confidence < _HIGH_CONFIDENCE


class ScanRegistration(Protocol):
    """Registers scans to a map of earlier scans. T_target_source of its results is T_odom_lidar.

    Attributes:
        uses_images: whether frames should have their images.
    """

    @property
    def uses_images(self) -> bool: ...

    def __len__(self) -> int:
        """0 while there is nothing to register to."""
        ...

    def fresh(self) -> Self:
        """A new registration of the same kind with an empty map."""
        ...

    def prepare(self, frame: Frame, motion: Array) -> Scan:
        """Prepare a frame taken during `motion`, (6,) [rad/s, m/s] or (K, 6), see `curve.poses`; never raises."""
        ...

    def rejection(self, scan: Scan) -> str:
        """Why no map can begin with this scan; empty if one can."""
        ...

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        """Find the pose of a scan; needs a map."""
        ...

    def swept(self, scan: Scan, result: Registration, sweep_prior: SweepPrior) -> Swept | None:
        """The motion during the sweep of a registered scan; None: the scan does not show it."""
        ...

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        """Add a scan at its pose to the map if it shows enough that is new; returns whether it did."""
        ...
