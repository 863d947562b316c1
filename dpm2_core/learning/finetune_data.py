# SPDX-License-Identifier: Apache-2.0
"""Data of a fine-tuning: a user's drives with the SLAM's trajectory as reference, packed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from dpm2_core.data.source import Source
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.kitti_metric import known
from dpm2_core.evaluation.pair_set import FAR, NEAR, has_pair
from dpm2_core.frame import Array, Frame
from dpm2_core.learning.finetune_settings import DRIVES, HELD_OUT, REHEARSAL, FinetuneSettings
from dpm2_core.learning.generate import check_same, generate, pack
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.settings import Config, SlamSettings


class Referenced:
    """A source with the poses of a SLAM instead of the truth; NaN where it had none."""

    def __init__(self, source: Source, poses: Array) -> None:
        self.name, self.notes, self.poses, self.truth = source.name, source.notes, poses, "SLAM"
        self.T_cam_lidar = None
        self._source = source

    def __len__(self) -> int:
        return len(self._source)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        yield from self._source.frames(start, stop)


def refer(source: Source, settings: SlamSettings, advance: Callable[[], None] = lambda: None) -> Referenced:
    """The source with the trajectory that the SLAM finds for it, loops closed."""
    result = OfflineRun(source, Config(slam=settings)).run(lambda tracked: advance())
    if result.interrupted:  # half a reference is none
        raise KeyboardInterrupt
    poses = result.poses.copy()
    poses[~np.array(result.registered, bool)] = np.nan
    return Referenced(source, poses)


def prepare(
    sources: Sequence[Source], settings: FinetuneSettings, network: NetworkSettings, slam: SlamSettings, out: Path,
    advance: Callable[[str], None] = lambda what: None,
) -> list[str]:  # fmt: skip
    """Drives with their references, their last parts and the rehearsal, packed below `out`; what is there stays.

    Returns:
        Notes: of which drives the part that is held out has nothing to measure.

    Raises:
        UsageError: the SLAM could hardly follow a drive, or one that is there is another one or of other settings.
    """
    common = settings.model_dump(mode="json", include={"reference", "held_out", "input"})
    slam = slam.model_copy(update={"registration": settings.reference})
    notes, names = list[str](), [f"{i:02d}_{source.name.replace('/', '_')}" for i, source in enumerate(sources)]
    for kept in (out / DRIVES, out / HELD_OUT):
        if left := sorted({path.name for path in kept.glob("*/")} - set(names)):
            raise UsageError(f"{kept / left[0]}: of a drive that is not asked for; remove it, or choose another folder")
    for name, source in zip(names, sources, strict=True):
        asked = {**common, "scans": len(source)}
        if (out / DRIVES / name).exists():  # the last to be written
            check_same(out / DRIVES / name, asked)
            continue
        referenced = refer(source, slam, partial(advance, f"{name}: reference by SLAM"))
        followed = int(known(referenced.poses).sum())
        if followed < 2 * settings.frames:
            raise UsageError(f"{source.name}: the SLAM followed {followed} of {len(source)} scans; nothing to learn")
        cut = round(len(source) * (1 - settings.held_out))
        packing = partial(advance, f"{name}: packing")
        if _is_measurable(referenced.poses[cut:]):
            pack(referenced, out / HELD_OUT / name, network, range(cut, len(source)), packing, asked)
        elif cut < len(source):
            lacks = f"no pairs up to {NEAR:g} m and {NEAR:g} to {FAR:g} m apart, as are measured"
            notes.append(f"{name}: the {len(source) - cut} scans that are held out have {lacks}")
        pack(referenced, out / DRIVES / name, network, range(cut), packing, asked)
    if settings.rehearsal_share > 0 and not settings.rehearsal:
        worlds = settings.rehearsal_worlds.model_copy(update={"preset": network.preset})
        generate(out / REHEARSAL, worlds, 1, lambda done, total: advance(f"rehearsal: world {done} of {total}"))
    return notes


def _is_measurable(poses: Array) -> bool:
    """Whether pairs of every distance that `PairSet` draws are among (N, 4, 4) poses."""
    return has_pair(poses, 0.0, NEAR) and has_pair(poses, NEAR, FAR)
