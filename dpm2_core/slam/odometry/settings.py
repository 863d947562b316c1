# SPDX-License-Identifier: Apache-2.0
"""Settings of the odometry."""

from __future__ import annotations

from pydantic import Field

from dpm2_core.config import Settings


class OdometrySettings(Settings):
    """When to accept a registration, and what to do when there is none."""

    max_turn: float = Field(200.0, ge=0)
    """A registration that turns by more than this off the predicted rate is rejected, deg/s (3 deg are free)."""
    turns: float = Field(0.0, ge=0, le=180)
    """A scan that does not fit is looked for at other headings as well, up to so many degrees to both sides: robots
    that turn on the spot; 0: not."""
    steadiness: float = Field(10.0, gt=0)
    """Standard deviation of the acceleration, m/s2 (and, in rad/s2, of the angular one): how far the prediction is
    trusted where the points do not constrain the pose, as along a tunnel. Elsewhere they outweigh it."""
    degraded_sigma: float = Field(0.08, gt=0)
    """Standard deviation of the position in its worst direction above which that direction counts as open, m: images
    and intensities are asked (`visual`), and where they do not know either, the state is `degraded`."""
    pause: float = Field(0.65, ge=0)
    """Seconds without a registration after which one scan alone is no longer accepted; in a stream of fewer frames
    per second 1.5 of its periods, and 2 s where a node has left clouds out for want of time."""
