# SPDX-License-Identifier: Apache-2.0
"""The image where the geometry is silent, from scan to scan: see `texture`. In town no image is ever touched.

Both images are of one camera. One is enough for one number, so that of two cameras the second is asked only where the
earlier scan has no image of the first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.geometry.deskew import placed
from dpm2_core.slam.preprocess import Scan
from dpm2_core.slam.registration.protocol import Prediction, ScanRegistration
from dpm2_core.slam.registration.texture import Reference, VisualSettings, along, reference, textured

_LEAST_REACH = 0.6  # m: however well the motion is known
_PERIOD = 0.1  # s, of most LiDARs: the prediction is of one period, its error over that time is the error of the speed
_ANY_SPEED = 15.0  # m/s, standard deviation while it is not known


class VisualScanRegistration:
    """Any registration, and the image along the direction that it leaves open."""

    def __init__(self, settings: VisualSettings, registration: ScanRegistration) -> None:
        self._settings = settings
        self._registration = registration
        self._last: tuple[Scan, Array] | None = None  # a scan with images and where it was taken
        self._reference: Reference | None = None  # made of it when first needed

    uses_images = True

    def __len__(self) -> int:
        return len(self._registration)

    def clear(self) -> None:
        self._registration.clear()
        self._last = self._reference = None

    def fresh(self) -> VisualScanRegistration:
        return VisualScanRegistration(self._settings, self._registration.fresh())

    def prepare(self, frame: Frame, twist: Array) -> Scan:
        return replace(self._registration.prepare(frame, twist), images=frame.images, twist=twist)

    def rejection(self, scan: Scan) -> str:
        return self._registration.rejection(scan)

    def register(self, scan: Scan, prediction: Prediction) -> Registration:
        result = self._registration.register(scan, prediction)
        if not result.ok or self._last is None or result.worst_sigma <= self._settings.sigma:
            return result
        earlier = self._last[0].images[0].camera.name
        image = next((image for image in scan.images if image.camera.name == earlier), None)
        return result if image is None else self._along(result, image, scan.twist, prediction.information)

    def update(self, scan: Scan, T_odom_lidar: Array) -> bool:
        if scan.images and self._wants(T_odom_lidar):
            self._last, self._reference = (scan, T_odom_lidar), None
        return self._registration.update(scan, T_odom_lidar)

    def _wants(self, T_odom_lidar: Array) -> bool:
        if self._last is None or self._reference is None:
            return True
        return bool(np.linalg.norm(self._last[1][:3, 3] - T_odom_lidar[:3, 3]) >= self._settings.baseline)

    def _along(self, result: Registration, image: Image, twist: Array, information: Array | None) -> Registration:
        """The result moved along its open direction to where the images agree; unchanged if they do not.

        `twist` (6,) is the motion of the scan, by which the camera is elsewhere at an image that was taken later than
        that of the earlier scan, relative to the scans.
        """
        s = self._settings
        reach, of_speed = s.reach, _ANY_SPEED
        if information is not None:
            b = np.concatenate([np.zeros(3), result.open_direction])
            sigma = float(np.sqrt(b @ np.linalg.solve(information, b)))
            reach, of_speed = min(reach, max(_LEAST_REACH, 4 * sigma)), sigma / _PERIOD
        assert self._last is not None
        scan, T_odom_ref = self._last
        if self._reference is None:
            axis = T_odom_ref[:3, :3].T @ result.T_target_source[:3, :3] @ result.open_direction
            self._reference = reference(scan.points, textured(scan.images[0], s.width), s.points, axis)
        # Only the difference: the twist itself follows from the images, so that moving the camera by its whole offset
        # feeds an error back, and it grows from half a period on. What is left is the offset times the change of speed.
        late = image.time_offset - scan.images[0].time_offset
        image_now = replace(textured(placed(image, late, twist), s.width), sigma=of_speed * abs(late))
        return along(s, result, self._reference, image_now, se3.inverse(T_odom_ref), reach)
