# SPDX-License-Identifier: Apache-2.0
"""Files of a run for later analysis: every frame, every loop that was tried, and the true trajectory, as text.

`frames.csv`, `loops.csv` and `ground_truth.tum` are next to the trajectory. The report and any spreadsheet read them.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.data.trajectory import Trajectory, read_trajectory, write_tum
from dpm2_core.errors import UsageError
from dpm2_core.estimates import Edge
from dpm2_core.evaluation.kitti_metric import known
from dpm2_core.files import atomic_write, explaining, make_folder, numbered
from dpm2_core.frame import Array

TRAJECTORY, FRAMES, LOOPS, TRUTH = "trajectory.tum", "frames.csv", "loops.csv", "ground_truth.tum"
METRICS, TIMING = "metrics.json", "timing.json"
POSES, CLOUD, GRAPH, PICTURE = "trajectory_kitti.txt", "map.ply", "pose_graph.g2o", "trajectory.png"
LOCALIZATION = "localisation.json"
MAPPING = (POSES, CLOUD, GRAPH, PICTURE, FRAMES, LOOPS, TRUTH, METRICS, TIMING)
"""Files of a run that makes a map, which a run that localizes does not have."""
_LOOP_COLUMNS = ("from_x", "from_y", "from_z", "to_x", "to_y", "to_z", "accepted", "method", "confidence", "overlap",
                 "reason")  # fmt: skip


@dataclass(frozen=True)
class LoopRow:
    """A loop that was tried: positions of its two keyframes in the map, m, and the verdict."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    accepted: bool
    reason: str = ""


@dataclass(frozen=True, eq=False)
class RunFolder:
    """A folder that `dpm2 run` or an experiment wrote.

    Attributes:
        trajectory: T_map_lidar, by stamp; may be empty. truth: the same in its own world frame, or None.
        states: of each frame. stages_ms: wall time of each frame by stage, (N,) each; {} for other programs.
        loops: that were tried. metrics, timing: content of these files; {} without.
    """

    path: Path
    trajectory: Trajectory
    truth: Trajectory | None = None
    states: list[str] = field(default_factory=list)
    stages_ms: dict[str, Array] = field(default_factory=dict)
    loops: list[LoopRow] = field(default_factory=list)
    metrics: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, Any] = field(default_factory=dict)


def write_frames(path: Path, keys: Sequence[Sequence[object]], seconds: dict[str, list[float]]) -> None:
    """Write frames.csv: (frame, stamp ns, state, method) of each, and wall time of each stage, ms.

    Raises:
        Dpm2Error: it could not be written.
    """
    with atomic_write(path) as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["frame", "stamp_ns", "state", "method", *(f"{stage}_ms" for stage in seconds)])
        for row, times in zip(keys, zip(*seconds.values(), strict=True), strict=True):
            table.writerow([*row, *(f"{1e3 * time:.3f}" for time in times)])


def write_loops(path: Path, loops: Sequence[Edge], poses: Array) -> None:
    """Write loops.csv; `poses` (K, 4, 4) T_map_kf of the keyframes.

    Raises:
        Dpm2Error: it could not be written.
    """
    with atomic_write(path) as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(_LOOP_COLUMNS)
        for loop in loops:
            r = loop.registration
            ends = (f"{x:.3f}" for node in (loop.from_node, loop.to_node) for x in poses[node, :3, 3])
            table.writerow([*ends, int(r.ok), r.method, f"{r.confidence:.4f}", f"{r.overlap:.4f}", r.reason])


def write_truth(path: Path, stamps: Sequence[int], poses: Array) -> None:
    """Write ground_truth.tum: (N, 4, 4) poses of the LiDAR; unknown ones, rows of NaN, are left out.

    Raises:
        Dpm2Error: it could not be written.
    """
    is_known = known(poses)
    write_tum(path, np.asarray(stamps, np.int64)[is_known], poses[is_known])


def remove_results(folder: Path, *names: str) -> None:
    """Remove files of an earlier run that this run does not write: they would be taken for its own.

    Raises:
        Dpm2Error: a file could not be removed.
    """
    for name in names:
        with explaining(folder / name, "not removed"):
            (folder / name).unlink(missing_ok=True)


def set_aside(folder: Path, name: str) -> Path:
    """Move the results of a run to a subfolder, so that the next run replaces none of them.

    Returns:
        That folder: `name`, or NAME-2, -3, ... if an earlier run was set aside under that name.

    Raises:
        Dpm2Error: a file could not be moved.
    """
    subfolder = next(path for path in numbered(folder / name) if not path.exists())
    make_folder(subfolder)
    for result in (TRAJECTORY, *MAPPING):
        with explaining(folder / result, f"not moved to {subfolder}"):
            if (folder / result).exists():
                (folder / result).replace(subfolder / result)
    return subfolder


def read_run(path: Path) -> RunFolder:
    """Read the folder of a run; only its trajectory is required.

    Raises:
        UsageError: no trajectory in it, or a damaged file, which is named.
    """
    if not (path / TRAJECTORY).is_file():
        raise UsageError(f"{path}: not a folder of a run: no {TRAJECTORY}, as `dpm2 run` and `dpm2 experiment` write")
    trajectory = read_trajectory(path / TRAJECTORY, allow_empty=True)  # empty if a localization found nothing
    if trajectory.kind != "tum":
        raise UsageError(f"{path / TRAJECTORY}: want 8 numbers a line, the stamp first")
    try:
        frames, loops = _rows(path / FRAMES), _rows(path / LOOPS)
        stages = [name for name in (frames[0] if frames else {}) if name.endswith("_ms")]
        return RunFolder(
            path,
            trajectory,
            read_trajectory(path / TRUTH) if (path / TRUTH).is_file() else None,
            [row["state"] for row in frames],
            {name.removesuffix("_ms"): np.array([_number(row[name]) for row in frames]) for name in stages},
            [_loop(row) for row in loops],
            _json(path / METRICS),
            _json(path / TIMING),
        )
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise UsageError(f"{path}: {FRAMES} or {LOOPS} is damaged: {error}") from None


def _loop(row: dict[str, str]) -> LoopRow:
    x, y, z, *end = (_number(row[name]) for name in _LOOP_COLUMNS[:6])
    return LoopRow((x, y, z), (end[0], end[1], end[2]), row["accepted"] == "1", row["reason"])


def _number(text: str) -> float:
    if not np.isfinite(value := float(text)):
        raise ValueError(f"{text} is not a number")
    return value


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_number)  # NaN is no JSON
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{path}: not JSON: {error}") from None
    if not isinstance(content, dict):
        raise UsageError(f"{path}: want a mapping")
    return content
