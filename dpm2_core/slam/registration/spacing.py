# SPDX-License-Identifier: Apache-2.0
"""Distance between the frames that enter a map: fixed, or, as in DeepPointMap, adapted to the registration residual."""

from __future__ import annotations

_MIN_METERS = 1.0
_MAX_RATIO = 2.0  # of the distance


class Spacing:
    """The distance, m; it increases with small residuals and decreases with large ones (DeepPointMap's code).

    Attributes:
        meters: the current distance.
    """

    def __init__(self, distance: float, residual: float) -> None:
        """`residual`: m, at and above which the distance shrinks to 1 m; 0: the distance is constant."""
        self._distance, self._residual = distance, residual
        self._ratio, self.meters = 1.0, distance

    def registered(self, rmse: float) -> None:
        """Update by the residual of a registration, m."""
        if self._residual:
            wanted = 2 * (1 - min(rmse / self._residual, 1.0)) ** 2
            self._ratio = min(0.9 * self._ratio + 0.1 * wanted, _MAX_RATIO)
            self.meters = max(self._distance * self._ratio, _MIN_METERS)
