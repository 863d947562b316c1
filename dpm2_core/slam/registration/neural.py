# SPDX-License-Identifier: Apache-2.0
"""Registration of a scan to a map by neural descriptors, against merged ones of keyframes; it needs no start."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.descriptors import Descriptors, LazyDescriptors
from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame, Image, Points, Up
from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.network.images import small_image
from dpm2_core.slam.preprocess import Preprocessor, Scan
from dpm2_core.slam.registration.descriptor_map import DescriptorMap
from dpm2_core.slam.registration.protocol import Prediction, agree
from dpm2_core.slam.registration.spacing import Spacing
from dpm2_core.slam.registration.swept import SweepPrior, Swept

if TYPE_CHECKING:  # torch takes seconds to import, and the geometric SLAM does without
    from dpm2_core.network.model import DeepPointMap2


class NeuralSettings(Settings):
    """Registration by the network; `registration` must not be `geometric`."""

    weights: str = "small"
    """Name of weights that come with dpm2, or path of a .safetensors file."""
    spacing: float = Field(1.0, gt=0)
    """A frame's descriptors enter the map after this much motion, m (or a rotation of 15 degrees)."""
    residual: float = Field(0.0, ge=0)
    """Residual at which `spacing` shrinks, as `keyframes.residual`."""
    frames: int = Field(2, ge=1, le=16)
    """Number of the map's frames, those nearest to the predicted pose, that are merged for the registration."""
    solver: Literal["consensus", "confident"] = "consensus"
    """How pairs of descriptors become a pose: by a consensus, with a second matching at the resulting pose; or, as in
    the paper, by a robust SVD that starts from the most confident pairs. Loops and relocalization use it, too."""
    refined: int = Field(0, ge=0, le=64)
    """Register a frame that enters the map a second time, to this many merged frames, and use the pose with the smaller
    covariance: the scan-to-map refinement of the paper. 0: off."""
    min_confidence: float = Field(0.1, ge=0, le=1)
    """Probability that a pose is right, below which it is rejected; the motion so far can contradict it here. In a
    search for a place, where nothing can, at least 0.6."""


_RADIUS = 20.0  # m: frames farther than this from the predicted pose are not used, unless all are farther
_MAX_SIGMA = 0.6  # m, standard deviation of the position in its worst direction
_MIN_SEARCH_CONFIDENCE = 0.6
"""Minimum confidence in a search for a place, as after a pause: nothing contradicts a wrong pose there, and wrong poses
agree with each other."""


class NeuralScanRegistration:
    """Registers descriptors to the descriptors of earlier frames. The prediction only selects these frames."""

    def __init__(self, settings: NeuralSettings, preprocessor: Preprocessor, model: DeepPointMap2) -> None:
        self.uses_images = model.encoder.image is not None
        self._settings = settings
        self._preprocessor = preprocessor
        self._model = model
        self._spacing = Spacing(settings.spacing, settings.residual)
        self._map = DescriptorMap(self._spacing, _RADIUS)

    def __len__(self) -> int:
        return len(self._map)

    def fresh(self) -> NeuralScanRegistration:
        return NeuralScanRegistration(self._settings, self._preprocessor, self._model)

    def prepare(self, frame: Frame, motion: Array) -> Scan:
        points, _ = self._preprocessor.measured(frame, motion)
        images = frame.images if self.uses_images else ()
        return Scan(
            points,
            description=LazyDescriptors(partial(self.describe, points, images, frame.up)),
            images=images,
            up=frame.up,
        )

    def describe(self, points: Points, images: tuple[Image, ...] = (), up: Up | None = None) -> Descriptors:
        """The descriptors of a prepared scan (P, 4) with its `up` as in `Frame`.

        Raises:
            Dpm2Error: the scan has none.
        """
        return self._model.describe(Frame(0, points, images=images, up=up))

    def rejection(self, scan: Scan) -> str:
        if scan.description is None:
            return "no descriptors"
        return "" if scan.descriptors is not None else scan.description.problem

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        T_predicted = prediction.starts[0]
        result = self._register_near(scan, T_predicted, self._settings.frames)
        if not result.ok:
            return result
        self._spacing.registered(result.rmse)
        if self._settings.refined and self._map.wants(result.T_target_source):
            second = self._register_near(scan, result.T_target_source, self._settings.refined)
            if second.ok and second.worst_sigma < result.worst_sigma:
                result = second
        min_confidence = self._settings.min_confidence
        if result.confidence < (max(min_confidence, _MIN_SEARCH_CONFIDENCE) if prediction.unique else min_confidence):
            return result.rejected(f"right with a probability of only {result.confidence:.0%}")
        if (sigma := result.worst_sigma) > _MAX_SIGMA:
            return result.rejected(f"position uncertain by {sigma:.2f} m")
        if prediction.information is not None:
            covariance = np.linalg.inv(prediction.information).astype(np.float64)
            if not agree(result, Registration(T_predicted, covariance, 0.0, np.inf, "predicted")):
                return result.rejected("contradicts the motion so far")
        return result

    def swept(self, scan: Scan, result: Registration, sweep_prior: SweepPrior) -> Swept | None:
        return None

    def _register_near(self, scan: Scan, T_near: Array, frames: int) -> Registration:
        """T_odom_lidar by the merged descriptors of the frames nearest to a pose (4, 4)."""
        if scan.descriptors is None:
            return Registration.failed("neural", self.rejection(scan), T_near)
        if (around := self._map.around(T_near, frames)) is None:
            return Registration.failed("neural", "no descriptors around", T_near)
        T_odom_kf, target = around
        result = self._model.register(scan.descriptors, target)
        if not result.ok:
            return Registration.failed("neural", result.reason, T_near)
        return replace(result, T_target_source=se3.orthonormalized(T_odom_kf @ result.T_target_source))

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        wanted = self._map.wants(T_odom_lidar)
        if wanted:
            self.keep(scan, T_odom_lidar)
        return wanted

    def keep(self, scan: Scan, T_odom_lidar: Array) -> None:
        """Add a scan at its pose to the map."""
        if scan.description is None:
            return
        description = scan.description
        if not description.made:  # do not keep the whole scan and its images, megabytes that may never be needed
            network = self._model.settings
            subset = scan.points[voxel_first(scan.points, network.points.voxel)]
            images = scan.images if self.uses_images else ()
            small = tuple(small_image(image, network.image) for image in images)
            description = LazyDescriptors(partial(self.describe, subset, small, scan.up))
        self._map.insert(description, T_odom_lidar)
