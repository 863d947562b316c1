# SPDX-License-Identifier: Apache-2.0
"""Image or intensity for directions that the geometry does not constrain, from scan to scan. Never used in towns.

Both images are from one camera. One is enough for one unknown, so a second camera is used only if the earlier scan has
no image of the first. If the intensities of the LiDAR determine the distance, the image checks them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.geometry.deskew import placed
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.intensity import IntensitySearch
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration, agree
from dpm2_core.slam.registration.swept import SweepPrior, Swept
from dpm2_core.slam.registration.texture import Reference, VisualSettings, along, reference, textured

_BASELINE = 3.0  # m: distance after which the reference image is replaced
_MAX_REACH, _MIN_REACH = 20.0, 0.6  # m to either side: largest search range, and the least for a known motion
_PERIOD = 0.1  # s, of most LiDARs: the prediction is over one period; its error divided by it is that of the speed
_UNKNOWN_SPEED_SIGMA = 15.0  # m/s, standard deviation of an unknown speed


class VisualScanRegistration:
    """Any registration, with image or intensity along the direction that it leaves unconstrained."""

    def __init__(self, settings: VisualSettings, registration: ScanRegistration, open_sigma: float) -> None:
        """open_sigma: standard deviation of the position, m, above which its worst direction is unconstrained."""
        self._settings, self._open_sigma = settings, open_sigma
        self._registration = registration
        self._last: tuple[Scan, Array] | None = None  # a scan with images and its pose
        self._reference: Reference | None = None  # computed from it when first needed
        self._intensity = IntensitySearch()
        self._fully_constrained = False  # whether the last scan left no direction unconstrained

    uses_images = True

    def __len__(self) -> int:
        return len(self._registration)

    def fresh(self) -> VisualScanRegistration:
        return VisualScanRegistration(self._settings, self._registration.fresh(), self._open_sigma)

    def prepare(self, frame: Frame, motion: Array) -> Scan:
        twist = np.atleast_2d(motion)[0]
        return replace(self._registration.prepare(frame, motion), images=frame.images, twist=twist)

    def rejection(self, scan: Scan) -> str:
        return self._registration.rejection(scan)

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        result = self._registration.register(scan, prediction)
        if result.ok and result.worst_sigma > self._open_sigma:
            result = self._locate_along_open_direction(scan, result, prediction.information)
        self._fully_constrained = result.ok and result.worst_sigma <= self._open_sigma
        return result

    def swept(self, scan: Scan, result: Registration, sweep_prior: SweepPrior) -> Swept | None:
        return self._registration.swept(scan, result, sweep_prior)

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        if scan.images and self._needs_reference(T_odom_lidar):
            self._last, self._reference = (scan, T_odom_lidar), None
        self._intensity.update(scan.points, T_odom_lidar, self._fully_constrained)
        return self._registration.update(scan, T_odom_lidar)

    def _needs_reference(self, T_odom_lidar: Array) -> bool:
        if self._last is None or self._reference is None:
            return True
        return bool(np.linalg.norm(self._last[1][:3, 3] - T_odom_lidar[:3, 3]) >= _BASELINE)

    def _locate_along_open_direction(self, scan: Scan, result: Registration, information: Array | None) -> Registration:
        """The result, moved along its unconstrained direction by the intensities, which need no calibration, or else by
        the image. If the two contradict each other, the covariance covers both."""
        reach, speed_sigma = self._search_range(result, information)
        by_image = self._by_image(scan, result, reach, speed_sigma)
        image_matches = by_image.method == "visual"
        by_intensity = self._intensity.along(result if image_matches else by_image, scan.points, reach)
        if by_intensity.method != "intensity":
            return by_image if image_matches else by_intensity
        if image_matches and not agree(by_intensity, by_image):
            difference = se3.way(by_intensity.T_target_source, by_image.T_target_source)
            return by_intensity.doubted(difference).because(
                f"image and intensities {np.linalg.norm(difference[3:]):.2f} m apart"
            )
        return by_intensity

    def _by_image(self, scan: Scan, result: Registration, reach: float, speed_sigma: float) -> Registration:
        """The result, moved along its unconstrained direction to where the images match; unchanged if they do not.

        If an image is taken later relative to its scan than that of the earlier scan, the camera's pose is adapted.
        """
        if self._last is None:
            return result
        earlier, T_odom_ref = self._last
        earlier_image = earlier.images[0]
        image = next((image for image in scan.images if image.camera.name == earlier_image.camera.name), None)
        if image is None:
            return result
        if self._reference is None:
            axis = T_odom_ref[:3, :3].T @ result.T_target_source[:3, :3] @ result.open_direction
            self._reference = reference(earlier.points, textured(earlier_image), axis)
        # Only the difference of the two delays: the twist depends on the images, so moving the camera by the whole
        # delay feeds errors back, which grow from half a period on. The remaining error: delay times speed change.
        delay = image.time_offset - earlier_image.time_offset
        image_now = replace(textured(placed(image, delay, scan.twist)), sigma=speed_sigma * abs(delay))
        return along(self._settings, result, self._reference, image_now, se3.inverse(T_odom_ref), reach)

    def _search_range(self, result: Registration, information: Array | None) -> tuple[float, float]:
        """Search range along the unconstrained direction, m, and the standard deviation of the speed along it, m/s."""
        if information is None:
            return _MAX_REACH, _UNKNOWN_SPEED_SIGMA
        b = np.concatenate([np.zeros(3), result.open_direction])
        sigma = float(np.sqrt(b @ np.linalg.solve(information, b)))
        return min(_MAX_REACH, max(_MIN_REACH, 4 * sigma)), sigma / _PERIOD
