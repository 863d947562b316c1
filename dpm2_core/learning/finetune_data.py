# SPDX-License-Identifier: Apache-2.0
"""Data of a fine-tuning: a user's drives with the SLAM's trajectory as reference, packed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpm2_core.console import Advance
from dpm2_core.data.source import Source
from dpm2_core.errors import UsageError
from dpm2_core.estimates import BETWEEN
from dpm2_core.evaluation.kitti_metric import known
from dpm2_core.evaluation.pair_set import FAR, NEAR, has_pair
from dpm2_core.evaluation.run_result import Result
from dpm2_core.frame import Array, Frame
from dpm2_core.learning.finetune_settings import DRIVES, HELD_OUT, REHEARSAL, FinetuneSettings
from dpm2_core.learning.generate import GenerateSettings, check_same, generate, pack
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.graph.graph_data import components
from dpm2_core.slam.settings import Config, SlamSettings
from dpm2_core.slam.system import SlamResult

_PART_DISTANCE = 1e4  # m: frames of unconnected parts make no pair


class Referenced:
    """A source with the poses of a SLAM instead of ground truth; NaN where the SLAM had none."""

    def __init__(
        self, source: Source, poses: Array, notes: Iterable[str] = (), timed: bool = True, in_parts: bool = False
    ) -> None:
        """Combine source and poses.

        Args:
            notes: findings of the SLAM about the drive. timed: whether the times of its points are right.
            in_parts: whether frames are parts of a sweep; then only the last part of each sweep has a pose.
        """
        self.name, self.notes, self.poses, self.truth = source.name, [*notes], poses, "SLAM"
        self.T_cam_lidar = None
        self._source, self._timed, self.in_parts = source, timed, in_parts

    def __len__(self) -> int:
        return len(self._source)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        for frame in self._source.frames(start, stop):
            yield frame if self._timed else replace(frame, time_offset=None)


def refer(source: Source, settings: SlamSettings, advance: Callable[[], None] = lambda: None) -> Referenced:
    """The source with the trajectory that the SLAM estimates for it, loops closed.

    Parts of the drive without a known relative pose, as after a pause during which the robot was carried away, are put
    far apart: each is a separate reference. Times of points that the motion contradicts, as those of clouds that were
    already deskewed, are removed.
    """
    times = ""

    def step(tracked: SlamResult) -> None:
        nonlocal times
        times = tracked.odometry.times
        advance()

    result = OfflineRun(source, Config(slam=settings)).run(step)
    if result.interrupted:  # an incomplete reference is not used
        raise KeyboardInterrupt
    part, poses = _part_of_frames(result), result.poses.copy()
    poses[~np.array(result.registered, bool)] = np.nan
    with_pose = np.flatnonzero(known(poses))
    last = with_pose[:-1][np.diff(part[with_pose]) != 0]
    poses[last] = np.nan  # deskewing uses the motion to the next frame, which is not known
    poses[:, 0, 3] += _PART_DISTANCE * part
    notes = []
    if (count := len(np.unique(part[with_pose]))) > 1:
        notes.append(
            f"the SLAM does not know the relative poses of {count} parts of the drive: each is used separately"
        )
    if times:
        notes.append("the point times are not used, because the motion contradicts them")
    return Referenced(source, poses, notes, timed=not times, in_parts=BETWEEN in result.methods)


def _part_of_frames(result: Result) -> NDArray[np.int32]:
    """(N,) number of the part of a drive that each frame is in: breaks divide a drive, and loops join parts again."""
    stretch = result.recorder.stretches
    keyframe_stretch = stretch[
        np.searchsorted(result.recorder.stamps, [keyframe.stamp for keyframe in result.mapper.keyframes])
    ]
    ties = [
        (keyframe_stretch[loop.from_node], keyframe_stretch[loop.to_node]) for loop in result.mapper.loops if loop.ok
    ]
    return components(int(stretch[-1]) + 1, np.array(ties, np.intp).reshape(-1, 2))[stretch]


def prepare(
    sources: Sequence[Source], settings: FinetuneSettings, network: NetworkSettings, slam: SlamSettings, out: Path,
    advance: Callable[[str], None] = lambda what: None,
) -> list[str]:  # fmt: skip
    """Pack drives with their references, their last parts and the rehearsal below `out`; existing ones stay.

    Returns:
        Notes: findings of the SLAM about drives, and drives whose held-out part has nothing to measure.

    Raises:
        UsageError: the SLAM could hardly track a drive, or an existing one is another drive or of other settings.
    """
    common = settings.model_dump(mode="json", include={"reference", "held_out", "input"})
    slam = slam.model_copy(update={"registration": settings.reference})
    notes, names = list[str](), [f"{i:02d}_{source.name.replace('/', '_')}" for i, source in enumerate(sources)]
    for folder in (out / DRIVES, out / HELD_OUT):
        if leftover := sorted({path.name for path in folder.glob("*/")} - set(names)):
            raise UsageError(
                f"{folder / leftover[0]}: is of a drive that was not given; remove it, or choose another folder"
            )
    for name, source in zip(names, sources, strict=True):
        requested = {**common, "scans": len(source)}
        if (out / DRIVES / name).exists():  # written last
            check_same(out / DRIVES / name, requested)
            continue
        referenced = refer(source, slam, partial(advance, f"{name}: reference by SLAM"))
        notes += [f"{name}: {text}" for text in referenced.notes]
        followed = int(known(referenced.poses).sum())
        if followed < 2 * settings.frames:
            raise UsageError(
                f"{source.name}: the SLAM has poses for only {followed} of {len(source)} scans; too few to train on"
            )
        cut = _cut(referenced, settings.held_out)
        packing = _text_progress(advance, f"{name}: packing")
        if _is_measurable(referenced.poses[cut:]):
            pack(referenced, out / HELD_OUT / name, network, range(cut, len(source)), packing, requested)
        elif cut < len(source):
            missing = f"no pairs up to {NEAR:g} m and {NEAR:g} to {FAR:g} m apart, which the measurement needs"
            notes.append(f"{name}: the {len(source) - cut} scans that are held out have {missing}")
        pack(referenced, out / DRIVES / name, network, range(cut), packing, requested)
    if settings.rehearsal_share > 0 and not settings.rehearsal:
        worlds = GenerateSettings(worlds=6, first_seed=3000, frames=40, preset=network.preset)
        generate(out / REHEARSAL, worlds, 1, _text_progress(advance, "rehearsal: world"))
    return notes


def _cut(referenced: Referenced, held_out: float) -> int:
    """Position at which the held-out part begins: with a whole sweep, if frames are parts of sweeps."""
    cut = round(len(referenced) * (1 - held_out))
    return 1 + int(known(referenced.poses[:cut]).nonzero()[0].max(initial=-1)) if referenced.in_parts else cut


def _text_progress(advance: Callable[[str], None], what: str) -> Advance:
    return lambda done, total: advance(f"{what} {done} of {total}")


def _is_measurable(poses: Array) -> bool:
    """Whether (N, 4, 4) poses contain pairs of every distance that `PairSet` draws."""
    return has_pair(poses, 0.0, NEAR) and has_pair(poses, NEAR, FAR)
