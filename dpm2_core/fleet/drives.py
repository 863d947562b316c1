# SPDX-License-Identifier: Apache-2.0
"""Drives of a fleet, given as paths or as a manifest; each is run by the code of `dpm2 run`, in its own folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

from pydantic import Field

from dpm2_core.config import Settings, load_settings, read_yaml, settings_from
from dpm2_core.console import Advance
from dpm2_core.data.source import Span, parse_range
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.run_result import Result
from dpm2_core.fleet.part import Figures, Part
from dpm2_core.network.pretrained import pretrained_names, weights_path
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.filters import filter_weights
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.slam.store.map_file import SUFFIX

MAP = f"drive{SUFFIX}"
"""The map file in the folder of a drive."""
_WORK = "dpm2_core.fleet.drives:run_drive"
_MANIFEST_SUFFIXES = (".yaml", ".yml")


class ManifestDrive(Settings):
    """A drive of a manifest."""

    path: str
    """The recording; relative to the manifest's folder."""
    name: str = ""
    """Its folder in the results; by default the name of its last folder or file."""
    frames: str = ":"
    """Which frames, a:b by position from 0."""
    gt: str = ""
    """Ground truth (KITTI: left camera; TUM: LiDAR), relative to the manifest's folder."""
    set: tuple[str, ...] = ()
    """Its own KEY=VALUE, such as input.points_topic=/ouster/points."""


class Manifest(Settings):
    """Drives, and the settings of each."""

    drives: list[ManifestDrive] = Field(min_length=1)


def read_drives(given: Sequence[Path]) -> list[ManifestDrive]:
    """Drives from their paths, or those of a single given manifest; all with unique names.

    Raises:
        UsageError: an invalid manifest, a name twice, or one that a folder cannot have.
    """
    drives = [ManifestDrive(path=str(path)) for path in given]
    root = Path()
    if len(given) == 1 and given[0].suffix in _MANIFEST_SUFFIXES:
        drives, root = settings_from(Manifest, read_yaml(given[0]), default=str(given[0])).drives, given[0].parent
    resolved = [_resolved(drive, root.resolve()) for drive in drives]
    duplicates = [name for name, count in Counter(drive.name for drive in resolved).items() if count > 1]
    if duplicates:
        paths = " and ".join(drive.path for drive in resolved if drive.name == duplicates[0])
        raise UsageError(
            f"{paths}: both would have the name {duplicates[0]}; a list (docs/fleet.md) can give them names"
        )
    return resolved


def _resolved(drive: ManifestDrive, root: Path) -> ManifestDrive:
    path = (root / drive.path).resolve()
    name = drive.name or (path.stem if path.is_file() else path.name)
    if not name or name.startswith(".") or "/" in name:
        raise UsageError(f"{drive.path}: {name!r} cannot be the name of a folder")
    gt = str((root / drive.gt).resolve()) if drive.gt else ""
    return drive.model_copy(update={"path": str(path), "name": name, "gt": gt})


def parts_of(
    drives: Sequence[ManifestDrive], config: Path | None, overrides: Sequence[str], prefix: str = ""
) -> list[Part]:
    """A part for each drive.

    Args:
        config, overrides: as for `dpm2 run`, for all drives; a drive's own settings are applied last.
        prefix: put before the name of each drive.

    Raises:
        UsageError: an invalid setting or span of frames.
    """
    return [_part(drive, load_settings(Config, config, [*overrides, *drive.set]), prefix) for drive in drives]


def _part(drive: ManifestDrive, config: Config, prefix: str) -> Part:
    slam, inputs = _with_absolute_paths(config.slam)
    arguments = {
        "path": drive.path,
        "frames": parse_range(drive.frames),
        "gt": drive.gt,
        "config": config.model_copy(update={"slam": slam}),
    }
    if drive.gt:
        inputs.append(Path(drive.gt))
    return Part(prefix + drive.name, _WORK, arguments, inputs, fresh=True, cores=slam.threads)


def _with_absolute_paths(slam: SlamSettings) -> tuple[SlamSettings, list[Path]]:
    """The settings with absolute paths of weights, as a worker has another working directory; and these files."""
    files, changes = [], dict[str, Any]()
    if slam.uses_descriptors:
        files.append(weights_path(slam.neural.weights).resolve())
        if slam.neural.weights not in pretrained_names():
            changes["neural"] = slam.neural.model_copy(update={"weights": str(files[-1])})
    if slam.filter.kind != "none":
        files.append(filter_weights(slam.filter).resolve())
        if slam.filter.weights is not None:
            changes["filter"] = slam.filter.model_copy(update={"weights": files[-1]})
    return slam.model_copy(update=changes), files


def driven(run: OfflineRun, advance: Advance) -> Result:
    """The result of a run as a part; `advance` is called for each frame.

    Raises:
        KeyboardInterrupt: the run was stopped before its end.
    """
    done = count(1)
    result = run.run(lambda _: advance(next(done), len(run)))
    if result.interrupted:
        raise KeyboardInterrupt
    return result


def run_drive(folder: Path, advance: Advance, path: str, frames: Span, gt: str, config: Config) -> Figures:
    """Run a drive; writes the files of `dpm2 run` and its map to the folder.

    Raises:
        UsageError: a recording that cannot be opened. Dpm2Error: results that cannot be written.
    """
    with OfflineRun(path, config, frames, gt or None, folder / MAP) as run:
        result = driven(run, advance)
        if problem := result.mapper.store_problem:
            raise Dpm2Error(f"map file incomplete: {problem}")
        notes = [*run.source.notes, *result.save(folder)]
        loops, metrics = [loop.ok for loop in result.mapper.loops], result.metrics
        return {
            "frames": len(result),
            "failed_frames": result.methods["failed"],
            "breaks": result.recorder.breaks,
            "keyframes": len(result.mapper.keyframes),
            "loops": {"accepted": sum(loops), "rejected": len(loops) - sum(loops)},
            "fps": result.fps,
            "metrics": None if metrics is None else metrics.model_dump(exclude={"per_length", "per_speed"}),
            "notes": notes,
        }
