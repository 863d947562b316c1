# SPDX-License-Identifier: Apache-2.0
"""Checks whether the fit of a scan to either side constrains a direction that a registration leaves unconstrained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.registration.icp import CORRELATED, DISTINCT, GeometricRegistration
from dpm2_core.slam.registration.local_map import LocalMap

_PROBE_DISTANCE = 1.0  # m to either side along a direction that may be unconstrained
_HOLD_INFORMATION = 1e7  # information, 1 / m2, that fixes a scan there: to less than a millimeter
_CONSTRAINED_SIGMA = 0.05  # m, standard deviation along a direction in which it fits clearly worse to either side


def probed(registration: GeometricRegistration, source: Array, target: LocalMap, result: Registration) -> Registration:
    """A result with an unconstrained direction, checked 1 m to either side along it; else unchanged.

    The covariance subtracts the noise of normals from their information. That is cautious where poles and trees are
    few, but needed in a tunnel. A direction is constrained if the scan fits clearly worse to either side, even if the
    rest of its pose may change there. Starts to either side find a better pose if the first one was off.
    """
    b = np.concatenate([np.zeros(3), result.open_direction])
    offsets = [se3.exp(meters * b) for meters in (-_PROBE_DISTANCE, _PROBE_DISTANCE)]
    found = [result, *(registration.register(source, target, result.T_target_source @ T) for T in offsets)]
    best = registration.likeliest(source, target, [_limit_sigma(r, b) for r in found])
    prior = _HOLD_INFORMATION * np.outer(b, b)
    rivals = [registration.register(source, target, best.T_target_source @ T, prior=prior) for T in offsets]
    density = registration.log_density(source, target, best.T_target_source)
    gains = [density - registration.log_density(source, target, rival.T_target_source) for rival in rivals]
    return best if all(_is_significant(gain) for gain in gains) else result


def _limit_sigma(result: Registration, b: Array) -> Registration:
    """The result with its standard deviation along a direction b (6,) limited to `_CONSTRAINED_SIGMA`."""
    C_b = result.of_scene @ b
    variance = float(b @ C_b)
    excess = max(variance - _CONSTRAINED_SIGMA**2, 0.0) / variance**2
    return replace(result, covariance=result.covariance - excess * np.outer(C_b, C_b))


def _is_significant(gain: Array) -> bool:
    """Whether log likelihoods of the points (N,) differ by more than chance."""
    return bool(gain.mean() > max(DISTINCT, 3 * gain.std() * np.sqrt(CORRELATED / len(gain))))
