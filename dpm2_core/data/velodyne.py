# SPDX-License-Identifier: Apache-2.0
"""Drives in KITTI's format: one file per scan of the HDL-64E, and an image with the same number."""

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

_PERIOD = 0.1  # s, one revolution of the LiDAR


class VelodyneDrive(IndexedSource):
    """Common base of KITTI odometry, raw and KITTI-360. `Frame.index` is the number in the file name.

    Attributes:
        numbers: (len,) numbers in the file names. stamps: (len,) ns, set by the subclass.
        camera: camera of the images; None if there are none, or if images are not used.
        vertical_angle_correction_deg: added to the elevation of each point.
        swept: whether scans are not de-skewed: each point then has a time offset from its azimuth, see `azimuth_time`.
    """

    numbers: NDArray[np.int64]
    stamps: NDArray[np.int64]
    camera: Camera | None = None
    vertical_angle_correction_deg: float
    swept = True

    def __init__(self, name: str, scans: Path, images: Path, settings: InputSettings) -> None:
        """Find the scans NNNNNN.bin in a folder.

        Raises:
            UsageError: there are no scans.
        """
        self._scans, self._images, self._settings = numbered_scans(scans), images, settings
        if not self._scans:
            hint = ": want a drive that is `_sync`" if self.swept else ""
            raise UsageError(f"{scans.parent}: no scans ({scans.name}/NNNNNN.bin) in this folder{hint}")
        super().__init__(name, len(self._scans))
        self.numbers = np.array([int(scan.stem) for scan in self._scans])

    def frame(self, position: int) -> Frame:
        """See `IndexedSource`."""
        scan, stamp = self._scans[position], int(self.stamps[position])
        points, problem = read_scan(scan)
        points = scale_intensity(points, self._settings.intensity_max)  # KITTI has 0..1, other recordings may not
        points = correct_vertical_angle(points, self.vertical_angle_correction_deg)
        images = images_of(image_of(scan, self._images), self.camera, self.notes)
        offset = azimuth_time(points) if self.swept else None
        return Frame(stamp, points, offset, images, index=int(scan.stem), problem=problem)

    def _read_stamps(self, path: Path) -> NDArray[np.int64]:
        """(len,) ns from a file whose line k is the time of scan k; at a constant rate if it is missing or too short.

        Raises:
            UsageError: a line is not a time.
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
        """Degrees to add to the elevation of each point: the value set, else that of the recording."""
        requested = self._settings.vertical_angle_correction_deg
        return self._known_correction() if requested == "auto" else requested

    def _known_correction(self) -> float:
        """KITTI's correction, unless scans show that they are from another LiDAR."""
        for position in {0, len(self) // 2, len(self) - 1}:
            if not may_be_hdl64(read_scan(self._scans[position])[0]):
                self.notes.append(
                    f"{self._scans[position]}: beams that KITTI's LiDAR does not have; its correction of"
                    f" {HDL64_CORRECTION_DEG} degrees is not applied (input.vertical_angle_correction_deg)"
                )
                return 0.0
        return HDL64_CORRECTION_DEG

    def _image_size(self) -> tuple[int, int] | None:
        """Size of the images; None without images, or if they are not used."""
        if not self._settings.images:
            return None
        return image_size((path for scan in self._scans if (path := image_of(scan, self._images))), self.notes)


def azimuth_time(points: Points) -> Points:
    """(N,) s relative to facing forward, -0.05..0.05, of points (N, 4) of a LiDAR that rotates clockwise (from above).

    Points on the left were measured before points on the right. KITTI-360's devkit (kitti360Scripts,
    `curl_velodyne_data`) and KISS-ICP's reader of KITTI raw assume this, and with it scans of KITTI odometry, from the
    same sensor, agree best with each other. Other converters assume counter-clockwise rotation.
    """
    return (-np.arctan2(points[:, 1], points[:, 0]) * (_PERIOD / (2 * np.pi))).astype(np.float32)
