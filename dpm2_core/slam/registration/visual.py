# SPDX-License-Identifier: Apache-2.0
"""Image or intensity where the geometry is silent, from scan to scan. In town neither is ever touched.

Both images are of one camera. One is enough for one number, so that of two cameras the second is asked only where the
earlier scan has no image of the first. Where the intensities of the LiDAR tell the way, the image is their check.
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
from dpm2_core.slam.registration.swept import Beginning, Swept
from dpm2_core.slam.registration.texture import Reference, VisualSettings, along, reference, textured

_BASELINE = 3.0  # m: way after which another image is the one to compare with
_REACH, _LEAST_REACH = 20.0, 0.6  # m to either side: the farthest that is looked, and however well the motion is known
_PERIOD = 0.1  # s, of most LiDARs: the prediction is of one period, its error over that time is the error of the speed
_ANY_SPEED = 15.0  # m/s, standard deviation while it is not known


class VisualScanRegistration:
    """Any registration, and image or intensity along the direction that it leaves open."""

    def __init__(self, settings: VisualSettings, registration: ScanRegistration, open_sigma: float) -> None:
        """open_sigma: standard deviation of the position, m, above which its worst direction counts as open."""
        self._settings, self._open_sigma = settings, open_sigma
        self._registration = registration
        self._last: tuple[Scan, Array] | None = None  # a scan with images and where it was taken
        self._reference: Reference | None = None  # made of it when first needed
        self._intensity = IntensitySearch()
        self._tied = False  # whether the last scan left no direction open

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
            result = self._told(scan, result, prediction.information)
        self._tied = result.ok and result.worst_sigma <= self._open_sigma
        return result

    def swept(self, scan: Scan, result: Registration, beginning: Beginning) -> Swept | None:
        return self._registration.swept(scan, result, beginning)

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        if scan.images and self._wants(T_odom_lidar):
            self._last, self._reference = (scan, T_odom_lidar), None
        self._intensity.update(scan.points, T_odom_lidar, self._tied)
        return self._registration.update(scan, T_odom_lidar)

    def _wants(self, T_odom_lidar: Array) -> bool:
        if self._last is None or self._reference is None:
            return True
        return bool(np.linalg.norm(self._last[1][:3, 3] - T_odom_lidar[:3, 3]) >= _BASELINE)

    def _told(self, scan: Scan, result: Registration, information: Array | None) -> Registration:
        """The result moved along its open direction by the intensities, which need no calibration, or else by the
        image; as uncertain as these are apart where they exclude each other."""
        reach, of_speed = self._reach(result, information)
        by_image = self._by_image(scan, result, reach, of_speed)
        seen = by_image.method == "visual"
        by_intensity = self._intensity.along(result if seen else by_image, scan.points, reach)
        if by_intensity.method != "intensity":
            return by_image if seen else by_intensity
        if seen and not agree(by_intensity, by_image):
            way = se3.way(by_intensity.T_target_source, by_image.T_target_source)
            return by_intensity.doubted(way).because(f"image and intensities {np.linalg.norm(way[3:]):.2f} m apart")
        return by_intensity

    def _by_image(self, scan: Scan, result: Registration, reach: float, of_speed: float) -> Registration:
        """The result moved along its open direction to where the images agree; unchanged if they do not.

        The camera is elsewhere at an image that was taken later, relative to the scans, than that of the earlier scan.
        """
        if self._last is None:
            return result
        earlier, T_odom_ref = self._last
        before = earlier.images[0]
        image = next((image for image in scan.images if image.camera.name == before.camera.name), None)
        if image is None:
            return result
        if self._reference is None:
            axis = T_odom_ref[:3, :3].T @ result.T_target_source[:3, :3] @ result.open_direction
            self._reference = reference(earlier.points, textured(before), axis)
        # Only the difference: the twist itself follows from the images, so that moving the camera by its whole offset
        # feeds an error back, and it grows from half a period on. What is left is the offset times the change of speed.
        late = image.time_offset - before.time_offset
        image_now = replace(textured(placed(image, late, scan.twist)), sigma=of_speed * abs(late))
        return along(self._settings, result, self._reference, image_now, se3.inverse(T_odom_ref), reach)

    def _reach(self, result: Registration, information: Array | None) -> tuple[float, float]:
        """How far to look along the open direction, m, and the standard deviation of the speed along it, m/s."""
        if information is None:
            return _REACH, _ANY_SPEED
        b = np.concatenate([np.zeros(3), result.open_direction])
        sigma = float(np.sqrt(b @ np.linalg.solve(information, b)))
        return min(_REACH, max(_LEAST_REACH, 4 * sigma)), sigma / _PERIOD
