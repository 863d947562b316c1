# SPDX-License-Identifier: Apache-2.0
"""Names in the folder of maps: NAME.dpm2map and, next to it, a folder NAME. Nothing is overwritten."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from dpm2_core.errors import UsageError
from dpm2_core.files import numbered
from dpm2_core.slam.store.map_file import SUFFIX, left_log

_DEFAULT_NAME = "drive"


class MapFolder:
    """The maps of one robot, in a folder that others may use as well.

    Attributes:
        folder: None if nothing is saved.
    """

    def __init__(self, folder: Path | None, robot: str) -> None:
        self.folder, self._robot = folder, robot

    @property
    def usual(self) -> Path:
        """The default map file of a drive, an argument of `free`; an empty path if nothing is saved."""
        return Path() if self.folder is None else self.folder / f"{_DEFAULT_NAME}{SUFFIX}"

    def file(self, name: str) -> Path:
        """The map of that name.

        Raises:
            UsageError: there is no folder.
        """
        if self.folder is None:
            raise UsageError("ros.map_name: ros.map_directory is empty")
        return self.folder / f"{name.removesuffix(SUFFIX)}{SUFFIX}"

    def of_robot(self, requested: Path) -> Path:
        """The path, with the robot's name added to that of the file."""
        return requested.with_name(self._with_robot(requested.stem) + requested.suffix)

    def free(self, requested: Path) -> Iterator[Path]:
        """Unused paths: `requested` with the robot's name and a number added. Neither the file, nor a folder for its
        clouds, nor a write-ahead log that a former map left exists."""
        for path in numbered(self.of_robot(requested), requested.suffix):
            if not _is_taken(path) and (self.folder is None or not (self.folder / path.stem).exists()):
                yield path

    def claimed(self, name: str, file: Path | None) -> Path:
        """Create a folder with that name or, if it is empty, with that of the drive's map file; never that of another
        drive.

        Raises:
            OSError: it cannot be created.
        """
        assert self.folder is not None
        own = file.stem if file is not None else self._with_robot(_DEFAULT_NAME)
        for folder in numbered(self.folder / (name.removesuffix(SUFFIX) or own)):
            if name and _is_taken(map_file_of(folder)):
                continue  # another drive's map
            with suppress(FileExistsError):
                folder.mkdir(parents=True)
                return folder
        raise AssertionError

    def hint(self) -> str:
        """The newest map in the folder, in words; empty if there is none."""
        found = sorted(self.folder.glob(f"*{SUFFIX}"), key=_modification_time) if self.folder is not None else []
        return f"; the newest in {self.folder} is {found[-1]}" if found else ""

    def _with_robot(self, stem: str) -> str:
        return f"{stem}_{self._robot.replace('/', '_')}" if self._robot else stem


def map_file_of(folder: Path) -> Path:
    """The map file that belongs to a folder of clouds."""
    return folder.with_name(f"{folder.name}{SUFFIX}")


def _is_taken(file: Path) -> bool:
    """Whether there is a map, or the write-ahead log that a moved map left behind and needs."""
    return file.exists() or left_log(file) is not None


def _modification_time(path: Path) -> float:
    return path.stat().st_mtime
