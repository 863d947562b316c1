# SPDX-License-Identifier: Apache-2.0
"""ICP combined with the network's registration: each checks the other; disagreement is reported in `reason`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from dpm2_core.descriptors import LazyDescriptors
from dpm2_core.estimates import Registration, isotropic
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.motion import OPEN
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.icp import GeometricScanRegistration
from dpm2_core.slam.registration.neural import NeuralScanRegistration
from dpm2_core.slam.registration.protocol import CHI2_95, Prediction, agree, near
from dpm2_core.slam.registration.swept import SweepPrior, Swept

_START_INFORMATION = np.diag(np.repeat([np.radians(2), 0.5], 3) ** -2.0)
"""Information of a network pose with a standard deviation of 2 degrees and 0.5 m: enough to initialize ICP."""

_UNCONFIRMED_COVARIANCE = isotropic(np.radians(1), 0.3)
"""Covariance added to that of a network pose if the points fit nowhere near it: hovering above a town, such poses have
errors of 0.27 m and report 0.06 m."""
_MIN_CONFIDENCE_GAIN = 0.1  # confidence: gain in fitting points that counts while a direction is unconstrained
_CONSTRAINED_SIGMA = 0.08  # m, standard deviation of a position that is constrained in all directions


class FusedScanRegistration:
    """ICP, initialized and checked by the network's registration.

    If both agree (see `agree`), the pose is that of the points. If they disagree, ICP also starts from the network's
    pose, and the more likely of its results is kept, unless the points are exactly at the predicted pose: with repeated
    structures, such as doors and parked cars, a wrong pose nearby may fit better. Points that are away from the
    predicted pose are registered anew from a network's pose that they agree with. If little is known of the motion, ICP
    starts there at once: a direction that seems unconstrained from afar may be constrained at the right pose. If ICP
    fails, it is tried again from the network's pose. If it fails there too, or converges elsewhere, the network's pose
    is returned with a larger covariance than its own, and drawn to the predicted pose if that is known and elsewhere.
    `reason` states which of the two disagreed, and why.
    """

    def __init__(
        self, neural: NeuralScanRegistration, geometric: GeometricScanRegistration, always: bool = True
    ) -> None:
        """`always` False: use the network only if the points do not determine their pose: few fit, or a direction is
        unconstrained. Of 700 pairs of real and simulated scans with unknown motion, all whose points did were right."""
        self._neural = neural
        self._geometric = geometric
        self._always = always
        self.uses_images = neural.uses_images

    def __len__(self) -> int:
        return len(self._geometric)

    def fresh(self) -> FusedScanRegistration:
        return FusedScanRegistration(self._neural.fresh(), self._geometric.fresh(), self._always)

    def prepare(self, frame: Frame, motion: Array) -> Scan:
        scan = self._geometric.prepare(frame, motion)
        images = frame.images if self.uses_images else ()
        description = LazyDescriptors(partial(self._neural.describe, scan.points, images, frame.up))
        return replace(scan, description=description, images=images, up=frame.up)

    def rejection(self, scan: Scan) -> str:
        return self._geometric.rejection(scan)

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        points = None if self._always else self._geometric.located(scan, prediction)
        if points is not None:
            doubted = self._geometric.doubted(scan, prediction, points)
            if _is_reliable(doubted, prediction) and not prediction.is_stray(doubted):
                return doubted
        # Compare with the result before the doubt: with the doubt's large covariance everything agrees.
        return self._geometric.doubted(scan, prediction, self._combine_with_network(scan, prediction, points))

    def swept(self, scan: Scan, result: Registration, sweep_prior: SweepPrior) -> Swept | None:
        return self._geometric.swept(scan, result, sweep_prior)

    def _combine_with_network(self, scan: Scan, prediction: Prediction, points: Registration | None) -> Registration:
        """Combine with the network's registration; `points` is None if they are not registered yet (`always`)."""
        neural = self._neural.register(scan, prediction) if len(self._neural) else None
        if neural is not None and neural.ok and not prediction.possible(neural.T_target_source):
            neural = neural.rejected("found a pose that no vehicle can have reached")
        if neural is not None and neural.ok and not prediction.known:
            points, prediction = self._register_from_both_poses(scan, neural, prediction, points)
        points = points or self._geometric.located(scan, prediction)
        if neural is None:
            return points.because("neural: no descriptors yet")
        if not neural.ok:
            return points.because(f"neural: {neural.reason}")
        if not points.ok:
            return self._fall_back_on_network(scan, neural, prediction)
        return self._select_or_combine(scan, prediction, points, neural)

    def _register_from_both_poses(
        self, scan: Scan, neural: Registration, prediction: Prediction, points: Registration | None
    ) -> tuple[Registration, Prediction]:
        """Register the points from the network's pose as well; returns result and prediction, unless that misleads."""
        extended = _with_network_start(neural, prediction)
        found = self._geometric.located(scan, extended)
        if prediction.information is not None and not self._has_images(scan):
            points = points or self._geometric.located(scan, prediction)
            if _is_misleading(found, points):
                return points, prediction
        return found, extended

    def _select_or_combine(
        self, scan: Scan, prediction: Prediction, points: Registration, neural: Registration
    ) -> Registration:
        """Select or combine two results."""
        if prediction.expects(points.T_target_source) and not agree(points, neural, CHI2_95):
            return _contradicting_network(points, neural, prediction)
        agreed, close = agree(points, neural), near(points.T_target_source, neural.T_target_source)
        # A wrong pose that both agree on may leave a direction unconstrained that the right pose constrains.
        if prediction.known and not (agreed and (points.worst_sigma <= _CONSTRAINED_SIGMA or close)):
            starts = [points.T_target_source, neural.T_target_source]
            likelier = self._geometric.located(scan, replace(prediction, starts=starts))
            conclusive = not agreed or likelier.worst_sigma <= _CONSTRAINED_SIGMA
            if likelier.ok and conclusive and agree(likelier, neural):
                return _confirmed(likelier)
            points = likelier if likelier.ok and not agreed else points
        if not agreed:
            if not prediction.known and points.worst_sigma > _CONSTRAINED_SIGMA and self._has_images(scan):
                # Where points fit anywhere, they fit best at a pose without motion.
                return self._fall_back_on_network(scan, neural, prediction)
            return _contradicting_network(points, neural, prediction)
        if prediction.is_stray(points):  # the motion has changed and the points are stuck at the predicted pose
            from_network = self._register_from_network_pose(scan, neural)
            points = from_network if from_network.ok and agree(from_network, neural) else points
        if not self._always and _is_reliable(points, prediction):
            return points  # they needed the network only for the start
        return _confirmed(points)

    def _fall_back_on_network(self, scan: Scan, neural: Registration, prediction: Prediction) -> Registration:
        """Register the points from the network's pose, after the prediction did not lead to a result."""
        points = self._register_from_network_pose(scan, neural)
        if not points.ok:
            uncertain = replace(neural, covariance=neural.covariance + _UNCONFIRMED_COVARIANCE)
            return _fused_with_prediction(prediction, uncertain).because(f"not refined: {points.reason}")
        if agree(points, neural):
            return _confirmed(points)
        return _covering_both(neural, points)

    def _register_from_network_pose(self, scan: Scan, neural: Registration) -> Registration:
        return self._geometric.located(scan, Prediction([neural.T_target_source], 1.0, _START_INFORMATION))

    def _has_images(self, scan: Scan) -> bool:
        return self.uses_images and bool(scan.images)

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        kept = self._geometric.update(scan, T_odom_lidar)
        if kept:  # both maps have the same scans; the network's `update` is not called for every frame
            self._neural.keep(scan, T_odom_lidar)
        return kept


def _confirmed(points: Registration) -> Registration:
    """The points' result, confirmed by the network.

    A mean of both would be worse: at the walls of a building, with 16 beams, the network's poses have errors of 0.2 to
    0.4 m and report 0.06 m. Along a tunnel or a highway, where everything in a scan looks alike, the network reports
    standstill with high confidence.
    """
    return replace(points, method="refined")


def _fused_with_prediction(prediction: Prediction, neural: Registration) -> Registration:
    """A network pose that no points confirm, fused with the prediction by their covariances if the two are apart.

    In a fast rotation, with a LiDAR 70 degrees wide, such a pose was 0.5 m off, and the prediction 0.03 m.
    """
    T, T_predicted, information = neural.T_target_source, prediction.starts[0], prediction.information
    if information is None or not prediction.known or near(T_predicted, T):
        return neural
    covariance = neural.covariance + np.linalg.inv(information)
    xi = neural.covariance @ np.linalg.solve(covariance, se3.way(T, T_predicted))
    return replace(neural, T_target_source=se3.orthonormalized(T @ se3.exp(xi)))


def _is_misleading(found: Registration, points: Registration) -> bool:
    """Whether `found` is no reason to leave `points`: it fits hardly better, and leaves a direction unconstrained.

    A scan fits best where the map has the same density: on a highway with 16 beams up to 6 m away, by up to 0.06.
    """
    return points.ok and found.worst_sigma >= OPEN and found.confidence <= points.confidence + _MIN_CONFIDENCE_GAIN


def _with_network_start(neural: Registration, prediction: Prediction) -> Prediction:
    """Add the network's pose to the starts: as the first, preferred among equals, only without other information."""
    start, starts = neural.T_target_source, prediction.starts
    return replace(prediction, starts=[start, *starts] if prediction.information is None else [*starts, start])


def _is_reliable(points: Registration, prediction: Prediction) -> bool:
    """Whether points fit well and constrain all directions; exactly at the predicted pose any accepted result will do.

    Much of a scan after a large motion matches nothing in a young map of few beams. Both the network and the likelihood
    of the points then prefer the pose where the map was made, since the beams hit the same pattern there.
    """
    fits = prediction.fits_well(points) or prediction.expects(points.T_target_source)
    return points.ok and fits and points.worst_sigma <= _CONSTRAINED_SIGMA


def _contradicting_network(points: Registration, neural: Registration, prediction: Prediction) -> Registration:
    """The points' result, which contradicts the network; with a doubt unless the points fit well by themselves."""
    if prediction.fits_well(points):
        return points.because(_difference_text(points, neural))
    return _covering_both(points, neural)


def _covering_both(result: Registration, other: Registration) -> Registration:
    """One of two contradicting results, with a covariance that covers both: nothing shows which one is right."""
    difference = se3.way(result.T_target_source, other.T_target_source)
    return result.doubted(difference).because(_difference_text(result, other))


def _difference_text(a: Registration, b: Registration) -> str:
    xi = se3.way(a.T_target_source, b.T_target_source)
    return f"neural and geometric {np.linalg.norm(xi[3:]):.2f} m, {np.degrees(np.linalg.norm(xi[:3])):.1f} deg apart"
