# SPDX-License-Identifier: Apache-2.0
"""Point-to-plane least-squares registration to a local map; residuals are weighted by the uncertainty of the plane.

`GeometricRegistration` registers a cloud from one start; `GeometricScanRegistration` is the registration of the
odometry, with one or several starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.calibration import with_calibration
from dpm2_core.slam.preprocess import Preprocessor, Scan
from dpm2_core.slam.registration.local_map import LocalMap
from dpm2_core.slam.registration.point_to_plane import linearize
from dpm2_core.slam.registration.protocol import Prediction, fits_better, near
from dpm2_core.slam.registration.swept import SweepPrior, Swept, register_sweep


class GeometricSettings(Settings):
    """The geometric registration."""

    gate: float = Field(2.0, gt=0)
    """Correspondences farther apart than this are ignored in the first iteration, m; it shrinks to `final_gate`."""
    final_gate: float = Field(0.5, gt=0)
    """The same in the last iterations, m."""
    noise: float = Field(0.06, gt=0)
    """Standard deviation of a point on a perfect plane, m: range noise and calibration."""
    min_points: int = Field(80, ge=1)
    """A registration with fewer inliers is rejected."""
    min_inliers: float = Field(0.5, ge=0, le=1)
    """A registration with a smaller ratio of inliers is rejected. The limit is 0.3 if the map has at most 3 scans and
    the result agrees with the predicted motion (0.3 m, 2 degrees)."""


_MAX_ITERATIONS = 15  # of Gauss-Newton, at most
_MIN_INLIERS_EXPECTED = 0.3
"""Minimum ratio of inliers of an expected result in a map of few scans: traffic occludes parts of such a small map, so
fewer points match. In a larger map few matches mean a wrong pose."""
_COARSE_STEP, _FINE_STEP = (1e-3, 0.02), (1e-4, 1e-3)  # rad and m: a smaller step ends the pass
CORRELATED = 10
_NORMAL_NOISE = 0.12  # rad, of fitted normals; measured rms along smooth tunnels: 0.02 to 0.12, on open roads over 0.2

_MIN_UNMATCHED = 0.2  # fraction of the points; 1 % of 870 scans, real and simulated, have it, 8 % in dense traffic
_MIN_SECOND_MOVING, _MIN_SECOND_AT_REST = 0.15, 0.3
"""Fraction of the points that fit only a second pose, in motion and at rest: none of the 870 scans has half of it. With
people who walk along, and with walls that slide past while moving objects are taken for static, it is 0.16 to 0.31. At
rest, where the map was made, the beams hit much at the same distance again: with 16 beams in a hall full of shelves
0.17."""
_MIN_SECOND_DISTANCE = 0.05  # m, from one pose to a second one
_EQUAL_LIKELIHOOD = 0.02
"""Smaller differences of the points' mean log likelihood are not significant, such as along a tunnel."""
DISTINCT = 0.06
"""The mean log likelihood of a pose must exceed that of every other pose found in a search by this much."""
_SEARCH_POINTS = 400  # points that select the heading where the motion is unknown, and the likely poses of a search;
_MAX_CANDIDATES = 6  # number of these poses that are registered,
_CANDIDATE_STRIDE = 4  # with every fourth point; all points compare the best two
_AXES = np.eye(6)
_HEADINGS = np.array([se3.exp([0, 0, np.radians(yaw), 0, 0, 0]) for yaw in (0, 3, -3, 6, -6, 9, -9)])
_ROTATIONS = np.array(
    [np.eye(4)]
    + [se3.exp(np.radians(deg) * _AXES[2]) for deg in range(-45, 46, 3)]
    + [se3.exp(np.radians(deg) * axis) for axis in _AXES[:2] for deg in range(-20, 21, 4)]
)
"""Poses relative to the prediction for a robot that begins or ends a rotation, or is shaken, at 5 frames per second."""
_MIN_FIT_GAIN = 0.06  # least advantage of another heading (fit: 0 to 2): on a plain 0.05 is chance
_SAME_POSE = (1.0, 5.0)  # m and degrees: results within count as the same pose


class GeometricRegistration:
    """Iteratively reweighted Gauss-Newton; a coarse pass over every fourth point gives the full pass a close start."""

    def __init__(self, settings: GeometricSettings) -> None:
        self.settings = settings

    def register(
        self, source: Array, target: LocalMap, T_guess: Array, widen: float = 1.0, prior: Array | None = None
    ) -> Registration:
        """Pose of a scan in the map.

        Args:
            source: (N, 3) float64 points in the sensor frame.
            target: the local map; T_target_source is then T_odom_lidar.
            T_guess: (4, 4) prediction.
            widen: factor on the first gate, for an uncertain prediction.
            prior: (6, 6) information [rad, m] of the prediction. Along a tunnel only this determines the distance;
                anywhere else the points outweigh it. It is not part of the covariance of the result.
        """
        s, source = self.settings, target.in_sight(source)
        if len(source) < s.min_points or len(target) < s.min_points:
            reason = f"{len(source)} points against a map of {len(target)}; {s.min_points} needed"
            return Registration.failed("geometric", reason, T_guess)
        T, gate = T_guess, s.gate * widen
        H = np.zeros((6, 6))
        inliers, rmse, coarse = 0, np.inf, len(source) > 4 * s.min_points
        # Points that share a plane are not independent: the information of `CORRELATED` of them counts as one.
        predicted = prior is not None
        prior = 1e-6 * np.eye(6) if prior is None else CORRELATED * prior
        for _ in range(_MAX_ITERATIONS):
            points = np.ascontiguousarray(source[::4]) if coarse else source
            matched = self._match(points, target, T, gate)
            H, gradient, inliers, rmse = linearize(points, np.ascontiguousarray(T[:3, :3]), *matched)
            if inliers < s.min_points / 4:
                return Registration.failed("geometric", f"{inliers} of {len(points)} points near the map", T_guess)
            prior_gradient = prior @ se3.way(T_guess, T)
            step = np.linalg.solve(H + prior, -gradient - prior_gradient)
            T = T @ se3.exp(step)
            gate = max(0.7 * gate, s.final_gate)
            radians, meters = _COARSE_STEP if coarse else _FINE_STEP
            if np.linalg.norm(step[:3]) < radians and np.linalg.norm(step[3:]) < meters:
                if not coarse:
                    break
                coarse, gate = False, s.final_gate
        T = se3.orthonormalized(T)  # removes accumulated rounding errors
        ratio = inliers / len(points)
        expected = predicted and target.is_young and near(T_guess, T)
        min_ratio = min(_MIN_INLIERS_EXPECTED, s.min_inliers) if expected else s.min_inliers
        ok = inliers >= s.min_points and ratio >= min_ratio
        reason = "" if ok else f"{inliers} of {len(points)} points fit the map"
        result = Registration(T, _covariance(H), ratio, rmse, "geometric", ok, reason)
        return with_calibration(result, target.from_nearest_scan(T))

    def swept(self, scan: Scan, target: LocalMap, T: Array, sweep_prior: SweepPrior) -> Swept | None:
        """Pose and motion of the sweep of a scan that was registered at T (4, 4) as a rigid scan; None if its points
        have no times."""
        if not len(scan.times) or len(target) < self.settings.min_points:
            return None
        gate = 2 * self.settings.final_gate  # the ends of the sweep are farther from the map than its middle
        return register_sweep(scan, lambda points, T: self._match(points, target, T, gate), T, sweep_prior, CORRELATED)

    def likeliest(self, source: Array, target: LocalMap, found: Sequence[Registration]) -> Registration:
        """The best of several results, with a covariance that covers the farthest that is nearly as likely."""
        fit = [self.likelihood(source, target, r.T_target_source) for r in found]
        ok = max(r.ok for r in found)
        best = max(value for r, value in zip(found, fit, strict=True) if r.ok == ok)
        # The first of equally likely results: in a tunnel, where all poses fit, the one with the least motion.
        chosen = next(
            r for r, value in zip(found, fit, strict=True) if r.ok == ok and value >= best - _EQUAL_LIKELIHOOD
        )
        likely = [r for r, value in zip(found, fit, strict=True) if r.ok == ok and value >= best - DISTINCT]
        differences = [se3.way(chosen.T_target_source, other.T_target_source) for other in likely]
        return chosen.doubted(max(differences, key=lambda xi: float(np.linalg.norm(xi[3:]))))

    def likelihood(self, source: Array, target: LocalMap, T: Array) -> float:
        """Mean log likelihood of the (N, 3) points at a pose T_target_source: the greater, the better the pose fits.

        Distances along the normals are Cauchy distributed; a point without a counterpart has a density of 1 per meter,
        and so does a scan without points.
        """
        return float(self.log_density(source, target, T).mean()) if len(source) else 0.0

    def second(self, source: Array, target: LocalMap, result: Registration, T_guess: Array) -> Registration | None:
        """A second pose, near a guess, for many of the points that do not fit at `result`: they move together."""
        unmatched = np.ascontiguousarray(source[self.log_density(source, target, result.T_target_source) <= 0])
        found = self.register(unmatched, target, T_guess)
        at_rest = se3.magnitude(target.from_nearest_scan(found.T_target_source))[0] < _MIN_SECOND_DISTANCE
        min_points = (_MIN_SECOND_AT_REST if at_rest else _MIN_SECOND_MOVING) * len(source)
        return found if found.ok and found.confidence * len(unmatched) >= min_points else None

    def log_density(self, source: Array, target: LocalMap, T: Array) -> Array:
        """(N,) log density of each of the (N, 3) points, see `likelihood`; 0 where no surface explains a point."""
        residual, _, variance = self._match(source, target, T, self.settings.final_gate)
        return np.fmax(-0.5 * np.log(variance) - np.log1p(residual * residual / variance), 0)

    def fits(self, source: Array, target: LocalMap, T: Array) -> NDArray[np.bool_]:
        """Mask (N,) of the (N, 3) points that lie on a surface of the map, to three standard deviations."""
        residual, _, variance = self._match(source, target, T, self.settings.final_gate)
        return residual * residual < 9 * variance  # False for NaN

    def _match(self, source: Array, target: LocalMap, T: Array, gate: float) -> tuple[Array, Array, Array]:
        """For each point (N, 3) its distance (N,), m, from the surface within the gate, the normal (N, 3) and variance
        (N,), m2; NaN where there is none."""
        residual, normals, spread = target.match(source @ T[:3, :3].T + T[:3, 3], gate)
        return residual, normals, self.settings.noise**2 + spread


class GeometricScanRegistration:
    """Registers points to a local map of points."""

    uses_images = False

    def __init__(self, preprocessor: Preprocessor, registration: GeometricRegistration, local_map: LocalMap) -> None:
        self._preprocessor = preprocessor
        self._registration = registration
        self._local_map = local_map
        self._reset_second_pose()

    def __len__(self) -> int:
        return len(self._local_map)

    def _reset_second_pose(self) -> None:
        """Reset the second motion: a scan that has just entered the map fits there."""
        self._scans_since_insert = 0  # since then
        self._second_offset: Array | None = None  # (6,) from the pose of the last scan to the second pose
        self._T_second: Array | None = None  # (4, 4) by the last registration, for the next scan if this one is kept

    def fresh(self) -> GeometricScanRegistration:
        return GeometricScanRegistration(self._preprocessor, self._registration, self._local_map.fresh())

    def prepare(self, frame: Frame, motion: Array) -> Scan:
        return self._preprocessor.prepare(frame, motion)

    def rejection(self, scan: Scan) -> str:
        min_points = self._registration.settings.min_points
        return "" if len(scan.source) >= min_points else f"{len(scan.source)} points; a map needs {min_points}"

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        return self.doubted(scan, prediction, self.located(scan, prediction))

    def swept(self, scan: Scan, result: Registration, sweep_prior: SweepPrior) -> Swept | None:
        return self._registration.swept(scan, self._local_map, result.T_target_source, sweep_prior)

    def located(self, scan: Scan, prediction: Prediction) -> Registration:
        """As `register`, without the check for points that move together."""
        p = prediction
        if p.unique:
            return self._search(scan.source, p)
        starts = p.starts if p.known else [self._best_start(scan.source, T) for T in p.starts]
        found = [self._registration.register(scan.source, self._local_map, T, p.widen, p.information) for T in starts]
        if len(found) > 1:
            return self._registration.likeliest(scan.source, self._local_map, found)
        if p.known and (not p.fits_well(found[0]) or p.is_stray(found[0])):
            return self._register_after_jolt(scan.source, p, found[0])
        return found[0]

    def _register_after_jolt(self, source: Array, prediction: Prediction, result: Registration) -> Registration:
        """For points (N, 3) that fit badly at the predicted pose: the result from the best of the poses around it.

        A motion that begins or ends between two scans, such as a rotation, matches the points of a room to wrong walls.
        """
        T_start = self._best_start(source, prediction.starts[0], _ROTATIONS)
        if T_start is prediction.starts[0]:
            return result
        other = self._registration.register(source, self._local_map, T_start, prediction.widen)
        return other if fits_better(other, result) else result

    def doubted(self, scan: Scan, prediction: Prediction, result: Registration) -> Registration:
        """The result, with a covariance that covers a second pose if many of the points fit only there.

        It may be a crowd that walks along or the walls beside it, trucks or the street between them: the points do not
        show which of the two is static. If the second pose is no longer found although as many points do not fit, it
        is predicted by its motion.
        """
        self._T_second, source = None, scan.source
        if prediction.unique or not result.ok or result.confidence > 1 - _MIN_UNMATCHED:
            return result
        T = result.T_target_source
        T_expected = (
            None
            if self._second_offset is None
            else T @ se3.exp(self._second_offset * (self._scans_since_insert + 1) / self._scans_since_insert)
        )
        second = self._registration.second(source, self._local_map, result, T if T_expected is None else T_expected)
        self._T_second = T_expected if second is None else second.T_target_source
        if self._T_second is None:
            return result
        offset = se3.way(T, self._T_second)
        doubt = f"many points fit another motion, off by {np.linalg.norm(offset[3:]):.1f} m"
        return result.doubted(offset).because(doubt)

    def _best_start(self, source: Array, T: Array, motions: Array = _HEADINGS) -> Array:
        """A start (4, 4) with the heading where the scan fits best, since a curve may have begun or ended meanwhile.

        Otherwise, 0.6 s after the last scan, one scan in 40 converges to a wrong pose with 80 % of its points on the
        map. It costs no time: a better start needs fewer steps.
        """
        if not len(source):
            return T
        poses = T @ motions
        fit = self._local_map.fit(_subsampled(source), poses)
        return np.asarray(poses[fit.argmax()]) if fit.max() > fit[0] + _MIN_FIT_GAIN else T

    def _search(self, source: Array, prediction: Prediction) -> Registration:
        """The best pose of a search, if no other pose fits nearly as well."""
        poses = np.asarray(prediction.starts)
        sparse = _subsampled(source)
        candidates: list[Array] = []
        for i in np.argsort(-self._local_map.fit(sparse, poses), kind="stable"):
            if not any(near(poses[i], T, _SAME_POSE) for T in candidates):
                candidates.append(poses[i])
            if len(candidates) == _MAX_CANDIDATES:
                break
        subset = np.ascontiguousarray(source[::_CANDIDATE_STRIDE])
        found = [self._registration.register(subset, self._local_map, T).T_target_source for T in candidates]
        fit = [self._registration.likelihood(subset, self._local_map, T) for T in found]
        order = np.argsort(fit)[::-1]
        rival = next((found[i] for i in order if not near(found[i], found[order[0]], _SAME_POSE)), None)
        result, likelihood = self._register_with_likelihood(source, found[order[0]])
        if result.confidence < _MIN_INLIERS_EXPECTED:
            return replace(result, ok=False)
        if rival is not None:
            other, other_likelihood = self._register_with_likelihood(source, rival)
            meters, _ = se3.apart(result.T_target_source, other.T_target_source)
            same_pose = near(other.T_target_source, result.T_target_source, _SAME_POSE)
            if other_likelihood > likelihood - DISTINCT and not same_pose:
                return result.rejected(f"a place {meters:.1f} m away fits as well")
        return replace(result, ok=True, reason="")

    def _register_with_likelihood(self, source: Array, T: Array) -> tuple[Registration, float]:
        """Result of the registration from T, and its likelihood."""
        result = self._registration.register(source, self._local_map, T)
        return result, self._registration.likelihood(source, self._local_map, result.T_target_source)

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        wanted = self._local_map.wants(T_odom_lidar)
        if wanted:
            self._local_map.insert(scan.cloud, T_odom_lidar)
            self._reset_second_pose()
        else:
            self._scans_since_insert += 1
            self._second_offset = None if self._T_second is None else se3.way(T_odom_lidar, self._T_second)
            if self._second_offset is not None and np.linalg.norm(self._second_offset[3:]) < _MIN_SECOND_DISTANCE:
                self._second_offset = None  # of two trials of a scan, the second pose was chosen
        return wanted


def _subsampled(source: Array) -> Array:
    """At most `_SEARCH_POINTS` of the points (N, 3), N >= 1."""
    return source[:: -(-len(source) // _SEARCH_POINTS)]


def _covariance(H: Array) -> Array:
    """Covariance (6, 6) from the Hessian, minus the spurious information due to noise in the normals.

    Along a perfectly smooth tunnel every normal should be perpendicular to the axis. Their noise makes some appear
    tilted, and thus the motion along the axis appear constrained.
    """
    information = H / CORRELATED
    information[3:, 3:] -= _NORMAL_NOISE**2 * np.trace(information[3:, 3:]) * np.eye(3)
    eigenvalues, axes = np.linalg.eigh(information)
    return (axes / np.maximum(eigenvalues, 1.0)) @ axes.T  # no direction is worse than 1 m or 1 rad
