# SPDX-License-Identifier: Apache-2.0
"""Drives of KITTI's kind: a scan of the HDL-64E a file, and an image of the same number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.data.messages import scale_intensity
from dpm2_core.data.scan_file import image_of, image_size, images_of, numbered_scans, read_scan
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import IndexedSource
from dpm2_core.data.text import date_ns, read_lines
from dpm2_core.data.vertical_angle import HDL64_CORRECTION_DEG, correct_vertical_angle, may_be_hdl64
from dpm2_core.errors import UsageError
from dpm2_core.frame import Camera, Frame, Points

_PERIOD = 0.1  # s, a turn of the LiDAR


class VelodyneDrive(IndexedSource):
    """What KITTI odometry, raw and KITTI-360 have in common. `Frame.index` is the number in the file name.

    Attributes:
        numbers: (len,) those in the file names. stamps: (len,) ns; who derives from it finds them.
        camera: of its images; None where there are none, or none are wanted.
        vertical_angle_correction_deg: added to the elevation of each point.
        swept: whether scans are as measured: each point then has a time offset by its azimuth, see `azimuth_time`.
    """

    numbers: NDArray[np.int64]
    stamps: NDArray[np.int64]
    camera: Camera | None = None
    vertical_angle_correction_deg: float
    swept = True

    def __init__(self, name: str, scans: Path, images: Path, settings: InputSettings) -> None:
        """Find the scans, NNNNNN.bin, in a folder.

        Raises:
            UsageError: there are none.
        """
        self._scans, self._images, self._settings = numbered_scans(scans), images, settings
        if not self._scans:
            wanted = ": want a drive that is `_sync`" if self.swept else ""
            raise UsageError(f"{scans.parent}: no scans ({scans.name}/NNNNNN.bin) in this folder{wanted}")
        super().__init__(name, len(self._scans))
        self.numbers = np.array([int(scan.stem) for scan in self._scans])

    def frame(self, position: int) -> Frame:
        """As `IndexedSource`."""
        scan, stamp = self._scans[position], int(self.stamps[position])
        points, problem = read_scan(scan)
        points = scale_intensity(points, self._settings.intensity_max)  # KITTI's are in 0..1, not everyone's are
        points = correct_vertical_angle(points, self.vertical_angle_correction_deg)
        images = images_of(image_of(scan, self._images), self.camera, self.notes)
        offset = azimuth_time(points) if self.swept else None
        return Frame(stamp, points, offset, images, index=int(scan.stem), problem=problem)

    def _read_stamps(self, path: Path) -> NDArray[np.int64]:
        """(len,) ns by a file whose line k is the time of scan k; at a steady pace where it is missing or too short.

        Raises:
            UsageError: a line is no time.
        """
        lines = read_lines(path)
        if len(lines) <= self.numbers[-1]:
            return self._settings.steady_stamps(self.numbers, f"{path}: missing or too short", self.notes)
        stamps = [date_ns(lines[number].strip()) for number in self.numbers]
        if None in stamps:
            number = self.numbers[stamps.index(None)]
            raise UsageError(f"{path}:{number + 1}: {lines[number].strip()!r} is no time")
        return np.array(stamps, np.int64)

    def _correction(self) -> float:
        """Degrees to add to the elevation of each point: what is set, else what is known of the recording."""
        requested = self._settings.vertical_angle_correction_deg
        return self._known_correction() if requested == "auto" else requested

    def _known_correction(self) -> float:
        """KITTI's, unless scans show that another LiDAR made them."""
        for position in {0, len(self) // 2, len(self) - 1}:
            if not may_be_hdl64(read_scan(self._scans[position])[0]):
                self.notes.append(
                    f"{self._scans[position]}: beams that KITTI's LiDAR does not have; its correction of"
                    f" {HDL64_CORRECTION_DEG} degrees is not applied (input.vertical_angle_correction_deg)"
                )
                return 0.0
        return HDL64_CORRECTION_DEG

    def _image_size(self) -> tuple[int, int] | None:
        """None without images, or where none are wanted."""
        if not self._settings.images:
            return None
        return image_size((path for scan in self._scans if (path := image_of(scan, self._images))), self.notes)


def azimuth_time(points: Points) -> Points:
    """(N,) s from facing forward, -0.05..0.05, of points (N, 4) of a LiDAR that turns clockwise, seen from above.

    What is on the left was measured before what is on the right: so it is in KITTI-360's devkit (kitti360Scripts,
    `curl_velodyne_data`) and in KISS-ICP's reader of KITTI raw, and so scans of KITTI odometry, of the same sensor,
    agree best with each other. Other converters call the rotation counter-clockwise.
    """
    return (-np.arctan2(points[:, 1], points[:, 0]) * (_PERIOD / (2 * np.pi))).astype(np.float32)
