# SPDX-License-Identifier: Apache-2.0
"""Neural registration first, then the points; the one vouches for the other, and what differs is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.frame import Array, Frame, Registration
from dpm2_core.geometry import se3
from dpm2_core.slam.neural import NeuralScanRegistration
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.scan_registration import MAP_NOISE, GeometricScanRegistration, Prediction, agree


class RefinedScanRegistration:
    """The pose of the network, refined on the points where the two agree.

    The points are registered from the pose of the network, and by nothing else held to it. The difference xi of both is
    tested: xi^T (S_neural + S_geometric + S_map)^-1 xi <= `CHI2`. If it passes, the answer is their mean, each weighed
    with its information: in town the points have it, along a tunnel the network. If it does not, or one of the two has
    no answer, the other answers alone and `reason` says why.
    """

    def __init__(self, neural: NeuralScanRegistration, geometric: GeometricScanRegistration) -> None:
        self._neural = neural
        self._geometric = geometric

    @property
    def uses_images(self) -> bool:
        return self._neural.uses_images

    def __len__(self) -> int:
        return len(self._geometric)

    def clear(self) -> None:
        self._neural.clear()
        self._geometric.clear()

    def prepare(self, frame: Frame, twist: Array) -> Scan:
        return self._neural.described(frame, self._geometric.prepare(frame, twist))

    def refusal(self, scan: Scan) -> str:
        return self._geometric.refusal(scan)

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        neural = self._neural.register(scan, prediction) if len(self._neural) else None
        if neural is None or not neural.ok:
            why = "neural: no descriptors yet" if neural is None else f"neural: {neural.reason}"
            return _because(self._geometric.register(scan, prediction), why)
        refined = self._geometric.register(scan, Prediction([neural.T_target_source]))
        if not refined.ok:
            return replace(neural, reason=f"not refined: {refined.reason}")
        xi = se3.log(se3.inverse(refined.T_target_source) @ neural.T_target_source)
        if agree(neural, refined):
            return _mean(refined, neural, xi)
        return self._disputed(scan, prediction, neural, refined, f"neural and points {_apart(xi)} apart")

    def _disputed(
        self, scan: Scan, prediction: Prediction, neural: Registration, refined: Registration, why: str
    ) -> Registration:
        """The points have it if the prediction leads them to the same pose; else the network, with its doubt."""
        again = self._geometric.register(scan, prediction)
        if again.ok and agree(refined, again):
            return _because(again, why)
        xi = se3.log(se3.inverse(neural.T_target_source) @ refined.T_target_source)
        return replace(neural, covariance=neural.covariance + np.outer(xi, xi), reason=why)

    def update(self, scan: Scan, T_odom_lidar: Array) -> None:
        self._geometric.update(scan, T_odom_lidar)
        self._neural.update(scan, T_odom_lidar)


def _mean(refined: Registration, neural: Registration, xi: Array) -> Registration:
    """Both by their information; xi (6,) leads from the refined pose to the neural one."""
    of_points, of_network = np.linalg.inv(refined.covariance), np.linalg.inv(neural.covariance + MAP_NOISE)
    covariance = np.linalg.inv(of_points + of_network)
    T = se3.orthonormalised(refined.T_target_source @ se3.exp(covariance @ of_network @ xi))
    return replace(refined, T_target_source=T, covariance=covariance, method="refined")


def _apart(xi: Array) -> str:
    return f"{np.linalg.norm(xi[3:]):.2f} m, {np.degrees(np.linalg.norm(xi[:3])):.1f} deg"


def _because(answer: Registration, why: str) -> Registration:
    return replace(answer, reason="; ".join(part for part in (answer.reason, why) if part))
