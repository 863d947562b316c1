# SPDX-License-Identifier: Apache-2.0
"""`dpm2 run SRC --localise MAP`: localize a recording in a map, which stays as it is, byte for byte."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.commands.options import note
from dpm2_core.console import progress_bar
from dpm2_core.data.trajectory import write_tum
from dpm2_core.errors import UsageError
from dpm2_core.estimates import State
from dpm2_core.evaluation.run_folder import LOCALIZATION, MAPPING, TRAJECTORY, remove_results
from dpm2_core.evaluation.run_result import save_config
from dpm2_core.files import make_folder, write_json
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.loops.localizer import Localizer
from dpm2_core.slam.settings import Config
from dpm2_core.slam.system import SlamResult


def parse_hint(text: str) -> Array:
    """`x,y,yaw` (m, m, degrees) to T_map_lidar (4, 4).

    Raises:
        UsageError: the text has another form, or a number is not finite.
    """
    try:
        x, y, yaw = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--hint {text}: want x,y,yaw in meters and degrees, such as 12.5,-3,90") from None
    if not np.isfinite([x, y, yaw]).all():
        raise UsageError(f"--hint {text}: want finite numbers")
    return se3.make(se3.exp(np.array([0, 0, np.radians(yaw), 0, 0, 0]))[:3, :3], np.array([x, y, 0.0]))


class LocalizationReport:
    """States, poses and events of the frames of a localization run.

    Attributes:
        stamps: of the frames whose pose in the map was known, ns. poses: T_map_lidar (4, 4) of each of them.
    """

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer
        self._previous_state = localizer.state
        self.stamps: list[int] = []
        self.poses: list[Array] = []
        self._frames: Counter[State] = Counter()
        self._first_located: int | None = None
        self._events: list[dict[str, Any]] = []
        self._not_found_reason = ""  # why the last keyframe was not localized, as long as none was
        self._unreadable = ""  # why the map could not be read, the first time

    def add(self, result: SlamResult) -> str:
        """Add the result of the next frame. Returns a line about its event, or an empty text if there is none."""
        before, self._previous_state = self._previous_state, self._localizer.state
        tracked, located = result.odometry, None if result.map is None else result.map.located
        state = State.LOST if tracked.state is State.LOST else self._localizer.state
        number = self._frames.total()
        self._frames[state] += 1
        if state.located and result.T_map_lidar is not None:
            self.stamps.append(tracked.stamp)
            self.poses.append(result.T_map_lidar)
        if located is not None and located.unreadable:
            self._unreadable = self._unreadable or located.registration.reason
        if located is not None and self._first_located is None and not located.registration.ok:
            self._not_found_reason = located.registration.reason
        if located is None or located.state is before or located.state is State.TRACKING:
            return ""
        is_relocalized = located.state is State.RELOCALIZED
        kind = "kidnapped" if is_relocalized and before.located else "found" if is_relocalized else str(located.state)
        if is_relocalized and self._first_located is None:
            self._first_located = number
        event: dict[str, Any] = {
            "frame": tracked.index,
            "stamp_ns": tracked.stamp,
            "event": kind,
            "reason": located.registration.reason,
        }
        if is_relocalized:
            event["position_m"] = located.T_map_kf[:3, 3].round(3).tolist()
        self._events.append(event)
        return f"frame {tracked.index}: {kind} {event.get('position_m', '')}{located.registration.reason}"

    def summary(self) -> dict[str, Any]:
        """Content of localisation.json: frames by state, frames until the first localization (None if there was none,
        with the reason), events, and why the map could not be read, if so."""
        return {
            "frames": self._frames.total(),
            "frames_until_found": self._first_located,
            "not_found": self._not_found_reason if self._first_located is None else "",
            "map_unreadable": self._unreadable,
            "frames_located": len(self.stamps),
            "frames_by_state": {str(state): count for state, count in sorted(self._frames.items())},
            "kidnappings": sum(event["event"] == "kidnapped" for event in self._events),
            "events": self._events,
        }


def run_localized(drive: OfflineRun, out: Path, hint: Array | None, config: Config) -> tuple[str, dict[str, Any]]:
    """Localize a drive in a map and write localisation.json, trajectory.tum (frames with a known pose) and config.yaml.

    Files that only a mapping run writes are removed from the folder.

    Returns the outcome as a sentence, and the content of localisation.json.
    """
    localizer, name = drive.slam.localizer, drive.source.name
    assert localizer is not None
    report = LocalizationReport(localizer)
    if hint is not None:
        localizer.hint(hint)
    make_folder(out)
    with progress_bar() as bar:
        task = bar.add_task(name, total=len(drive))

        def progress(result: SlamResult) -> None:
            if info := report.add(result):
                bar.console.print(info, soft_wrap=True)
            bar.update(task, advance=1, description=f"{name} {localizer.state}")

        interrupted = drive.run(progress).interrupted
    if interrupted:
        note("interrupted; writing the results so far", "yellow")
    save_config(config, out)
    write_tum(out / TRAJECTORY, report.stamps, np.array(report.poses).reshape(-1, 4, 4))
    summary = report.summary()
    write_json(out / LOCALIZATION, summary)
    remove_results(out, *MAPPING)
    frames_until_found = summary["frames_until_found"]
    reason = f" ({summary['not_found']})" if summary["not_found"] else ""
    found = f"not found{reason}" if frames_until_found is None else f"found after {frames_until_found} frames"
    located = f"pose known in {len(report.stamps)} of {summary['frames']} frames"
    return f"{name}: {found}, {located}; results in {out}", summary
