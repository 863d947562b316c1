# SPDX-License-Identifier: Apache-2.0
"""Selects the loader for a recording."""

from __future__ import annotations

from pathlib import Path

from dpm2_core.data.rosbag2_folder import PACKED, STORAGES
from dpm2_core.data.scan_file import KITTI, KITTI_360, KITTI_CARLA, KITTI_RAW, drives_below, is_frames
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import Source
from dpm2_core.errors import UsageError

_OUSTER = (".pcap", ".osf")


def sequences_below(path: Path | str) -> list[str]:
    """Possible values of `input.sequence` for a folder of KITTI odometry, raw, -360 or -CARLA with several drives.

    Raises:
        UsageError: there is no such folder, or it contains no drive.
    """
    path = Path(path)
    if not path.is_dir():
        raise UsageError(f"{path}: no such folder")
    layouts = (KITTI_360, KITTI_RAW, KITTI_CARLA, f"sequences/{KITTI}", KITTI)
    found = next(filter(None, (drives_below(path, layout) for layout in layouts)), None)
    if found is None:
        raise UsageError(
            f"{path}: no drives below it (sequences/NN, DATE_drive_NNNN_sync, data_3d_raw/DRIVE or TOWN/generated)"
        )
    return found


def is_drive(path: Path) -> bool:
    """Whether this is a folder, or a file with a drive's file name: a bag, or a recording of an Ouster LiDAR."""
    return path.is_dir() or (path.is_file() and (path.suffix in (".bag", *_OUSTER) or is_rosbag2(path)))


def is_rosbag2(path: Path) -> bool:
    """Whether this is a .mcap or .db3 file, compressed or not, or a folder that contains one or its metadata."""
    files = [path] if path.is_file() else path.iterdir()
    return any(file.name.endswith((*STORAGES, *PACKED)) or file.name == "metadata.yaml" for file in files)


def _is_kitti_raw(path: Path) -> bool:
    """Whether this is a KITTI raw drive, or the folder of a date; KITTI-360 has the same layout in data_3d_raw."""
    if (path / "velodyne_points").is_dir():
        return path.parent.name != "data_3d_raw"
    return path.name != "data_3d_raw" and bool(drives_below(path, KITTI_RAW))


def open_source(path: Path | str, settings: InputSettings | None = None) -> Source:
    """Open a recording: a folder of KITTI odometry, raw, -360 or -CARLA, a folder of PCD or PLY files, a bag, or a
    recording of an Ouster LiDAR.

    Raises:
        UsageError: `path` does not exist or cannot be read; the message names what was found.
    """
    path, settings = Path(path), settings or InputSettings()
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    if settings.dataset:
        from dpm2_core.data.kiss_datasets import KissSource

        return KissSource(path, settings)
    if path.suffix in _OUSTER:
        from dpm2_core.data.ouster import OusterSource

        return OusterSource(path, settings)
    is_kitti = (path / "velodyne").is_dir() or (path / "sequences").is_dir()  # whatever else the folder contains
    # rosbags and its type store are slow to import, and are not needed for a KITTI folder.
    if path.is_file() or (not is_kitti and is_rosbag2(path)):
        from dpm2_core.data.bags import BagSource

        return BagSource(path, settings)
    if _is_kitti_raw(path.absolute()):
        from dpm2_core.data.kitti_raw import KittiRawSource

        return KittiRawSource(path, settings)
    if (path / "data_3d_raw").is_dir() or (path / "velodyne_points").is_dir():
        from dpm2_core.data.kitti360 import Kitti360Source

        return Kitti360Source(path, settings)
    is_carla = (path / "frames").is_dir() or (path / "generated").is_dir() or is_frames(path)
    if is_carla or drives_below(path, KITTI_CARLA):
        from dpm2_core.data.kitti_carla import KittiCarlaSource

        return KittiCarlaSource(path, settings)
    if not is_kitti and any(file.suffix.lower() in (".pcd", ".ply") for file in path.iterdir()):
        from dpm2_core.data.cloud_folder import CloudFolder

        return CloudFolder(path, settings)
    if not is_kitti and any(path.glob("*.bag")) and not drives_below(path, KITTI):
        from dpm2_core.data.bags import BagSource

        return BagSource(path, settings)
    from dpm2_core.data.kitti import KittiSource

    return KittiSource(path, settings)
