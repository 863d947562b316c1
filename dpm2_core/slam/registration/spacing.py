# SPDX-License-Identifier: Apache-2.0
"""How far apart frames are that enter a map: fixed, or, as DeepPointMap does, by how well scans register."""

from __future__ import annotations

_LEAST = 1.0  # m
_MOST = 2.0  # of the distance


class Spacing:
    """The distance, m, that widens where residuals are small and narrows where they are large (DeepPointMap's code).

    Attributes:
        meters: now.
    """

    def __init__(self, distance: float, residual: float) -> None:
        """`residual`, m, at and above which the distance shrinks to 1 m; 0: it stays as it is."""
        self._distance, self._residual = distance, residual
        self._ratio, self.meters = 1.0, distance

    def registered(self, rmse: float) -> None:
        """A scan was registered with that residual, m."""
        if self._residual:
            wanted = 2 * (1 - min(rmse / self._residual, 1.0)) ** 2
            self._ratio = min(0.9 * self._ratio + 0.1 * wanted, _MOST)
            self.meters = max(self._distance * self._ratio, _LEAST)
