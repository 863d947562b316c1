# SPDX-License-Identifier: Apache-2.0
"""Data sets that KISS-ICP reads, as a `Source`: MulRan, Newer College, NCLT, HeLiPR, Boreas, ...

I. Vizzo et al., "KISS-ICP", RA-L 2023; its package `kiss_icp.datasets` (MIT) has the loaders.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.data.cloud_folder import name_times
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import IndexedSource, note_once
from dpm2_core.errors import UsageError
from dpm2_core.extras import needs
from dpm2_core.frame import NO_POINTS, Array, Frame

_SWEEP_PERIOD = 0.1  # s, one revolution of the LiDAR
_NATIVE_LOADERS = ("generic", "mcap", "ouster", "rosbag")  # dpm2 reads these itself, with times and intensities


class KissSource(IndexedSource):
    """A drive read by KISS-ICP's loader `input.dataset`. See `Source`; there are no images and no intensities.

    Point times are taken as in KISS-ICP: fractions of the sweep, whose end is the stamp.

    Raises:
        UsageError: no such loader, it lacks a package, or it cannot read the folder.
    """

    def __init__(self, path: Path | str, settings: InputSettings | None = None) -> None:
        self._settings, self.path = settings or InputSettings(), Path(path)
        self._printed = ""  # output of the loader's constructor, which may name what is missing
        kind = self._settings.dataset
        with needs("datasets", f"input.dataset={kind}"):
            from kiss_icp.datasets import available_dataloaders, dataset_factory
        names = sorted(set(available_dataloaders()).difference(_NATIVE_LOADERS))
        if kind not in names:
            raise UsageError(f"input.dataset={kind}: there is no such loader; there are {', '.join(names)}")
        arguments = {"data_dir": self.path, "sequence": self._settings.sequence}
        self._loader = self._call_loader(lambda: dataset_factory(kind, **arguments))
        super().__init__(self.path.resolve().stem, int(self._call_loader(lambda: len(self._loader))))
        if not self._count:
            raise UsageError(f"{self.path}: KISS-ICP's loader {kind} finds no scans here")
        self.stamps, self.poses = self._read_stamps(), self._poses()
        self.truth = f"gt_poses of KISS-ICP's loader {kind}" if self.poses is not None else ""

    def frame(self, position: int) -> Frame:
        """See `IndexedSource`."""
        stamp = int(self.stamps[position])
        try:
            xyz, times = self._call_loader(lambda: self._loader[position])
        except UsageError as error:
            return Frame(stamp, NO_POINTS, index=position, problem=str(error))
        points = np.zeros((len(xyz), 4), np.float32)
        points[:, :3] = np.asarray(xyz)[:, :3]
        offset = self._offsets(np.asarray(times, np.float64).ravel(), len(points))
        return Frame(stamp, points, offset, index=position)

    def _call_loader(self, call: Any) -> Any:
        """Result of a call of the loader, which prints, exits and asserts if something is missing."""
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                result = call()
        except (Exception, SystemExit) as error:
            output = printed.getvalue() if isinstance(error, SystemExit) else f"{self._printed} {error}"
            message = " ".join(output.split()[-30:]) or type(error).__name__
            raise UsageError(f"{self.path}: KISS-ICP's loader {self._settings.dataset}: {message}") from None
        self._printed = self._printed or printed.getvalue()
        return result

    def _poses(self) -> Array | None:
        poses = getattr(self._loader, "gt_poses", None)
        if poses is None:
            return None
        poses = np.asarray(poses, np.float64)
        if poses.shape == (self._count, 4, 4) and np.isfinite(poses).all():
            return poses
        self.notes.append(f"{self.path}: no ground truth: {poses.shape} poses for {self._count} scans")
        return None

    def _read_stamps(self) -> Array:
        """(len,) ns: the loader's times, else the scans' names if they are times, else at constant `input.period`."""
        read_times = getattr(self._loader, "get_frames_timestamps", None)
        if read_times is not None:
            times = np.asarray(self._call_loader(read_times), np.float64).ravel()
            if len(times) == self._count and np.isfinite(times).all():
                return np.asarray(np.round(times * 1e9), np.int64)
        names = [Path(str(file)) for file in getattr(self._loader, "scan_files", ())]
        if len(names) == self._count and (named := name_times(names)):
            return np.asarray(named, np.int64)
        why = f"{self.path}: the loader has no times"
        return np.asarray(self._settings.steady_stamps(np.arange(self._count), why, self.notes))

    def _offsets(self, times: Array, count: int) -> Any:
        """(count,) s relative to the end of the sweep; None if the points have no times."""
        if len(times) != count or not count or np.ptp(times) == 0:
            note_once(self.notes, f"{self.path}: no time field: not de-skewed")
            return None
        return ((times - times.max()) / np.ptp(times) * _SWEEP_PERIOD).astype(np.float32)
