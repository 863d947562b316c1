# SPDX-License-Identifier: Apache-2.0
"""Whether a direction that a registration leaves open is closed by how the scan fits on either side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.registration.icp import CORRELATED, DISTINCT, GeometricRegistration
from dpm2_core.slam.registration.local_map import LocalMap

_PROBE = 1.0  # m either way along a direction that may be open
_HELD = 1e7  # information, 1 / m2, that keeps a scan there: to less than a millimeter
_CLOSED = 0.05  # m, standard deviation along a direction in which it fits clearly worse on either side


def probed(registration: GeometricRegistration, source: Array, target: LocalMap, result: Registration) -> Registration:
    """A result that leaves a direction open, after a look 1 m either way along it; unchanged if that is open.

    The covariance takes the noise of normals off what they say: cautious where poles and trees are few, and needed
    in a tunnel. A direction is closed where the scan fits clearly worse on either side, whatever else of its pose
    may change there. Starts on either side find the better place where the first one was off.
    """
    b = np.concatenate([np.zeros(3), result.open_direction])
    beside = [se3.exp(way * b) for way in (-_PROBE, _PROBE)]
    found = [result, *(registration.register(source, target, result.T_target_source @ T) for T in beside)]
    best = registration.likeliest(source, target, [_closed(r, b) for r in found])
    held = _HELD * np.outer(b, b)
    rivals = [registration.register(source, target, best.T_target_source @ T, prior=held) for T in beside]
    density = registration.log_density(source, target, best.T_target_source)
    gains = [density - registration.log_density(source, target, rival.T_target_source) for rival in rivals]
    return best if all(_is_clear(gain) for gain in gains) else result


def _closed(result: Registration, b: Array) -> Registration:
    """With its position known to `_CLOSED` along a direction, b (6,), or better, where it is already."""
    C_b = result.of_scene @ b
    variance = float(b @ C_b)
    excess = max(variance - _CLOSED**2, 0.0) / variance**2
    return replace(result, covariance=result.covariance - excess * np.outer(C_b, C_b))


def _is_clear(gain: Array) -> bool:
    """Whether log likelihoods of the points (N,) differ by more than by chance."""
    return bool(gain.mean() > max(DISTINCT, 3 * gain.std() * np.sqrt(CORRELATED / len(gain))))
