# SPDX-License-Identifier: Apache-2.0
"""Settings of the odometry."""

from __future__ import annotations

from pydantic import Field

from dpm2_core.config import Settings


class OdometrySettings(Settings):
    """When to accept a registration, and what to do when there is none."""

    max_turn: float = Field(200.0, ge=0)
    """A registration that rotates by more than this off the predicted rate is rejected, deg/s (3 deg are free)."""
    turns: float = Field(0.0, ge=0, le=180)
    """A scan that does not fit is also searched at other headings, up to this many degrees to both sides, for robots
    that turn on the spot; 0: off."""
    steadiness: float = Field(10.0, gt=0)
    """Standard deviation of the acceleration, m/s2 (and, in rad/s2, of the angular one): how far the prediction
    is trusted where the points do not constrain the pose, as along a tunnel. Elsewhere the points outweigh it."""
    degraded_sigma: float = Field(0.08, gt=0)
    """Standard deviation of the position in its worst direction, m, above which that direction counts as unconstrained:
    images and intensities are then used (`visual`), and if they do not constrain it either, the state is `degraded`."""
    pause: float = Field(0.65, ge=0)
    """Seconds without a registration after which a single scan is no longer accepted; in a slower stream 1.5 of its
    periods, and 2 s if a node has dropped clouds for lack of time."""
