# SPDX-License-Identifier: Apache-2.0
"""`dpm2 run SRC --localise MAP`: a recording in a map that stays as it is, byte for byte."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dpm2_core.commands.options import progress_bar
from dpm2_core.config import dump_settings
from dpm2_core.console import Console
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import Source
from dpm2_core.data.trajectory import write_tum
from dpm2_core.errors import UsageError
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array, Frame, State
from dpm2_core.geometry import se3
from dpm2_core.slam.session import open_for_localization
from dpm2_core.slam.settings import Config
from dpm2_core.slam.system import LocalizationSystem


def parse_hint(text: str) -> Array:
    """`x,y,yaw` (m, m, degrees) to T_map_lidar (4, 4).

    Raises:
        UsageError: it is something else.
    """
    try:
        x, y, yaw = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--hint {text}: want x,y,yaw in meters and degrees, such as 12.5,-3,90") from None
    if not np.isfinite([x, y, yaw]).all():
        raise UsageError(f"--hint {text}: not finite")
    return se3.make(se3.exp(np.array([0, 0, np.radians(yaw), 0, 0, 0]))[:3, :3], np.array([x, y, 0.0]))


class LocalizationReport:
    """What became of each frame.

    Attributes:
        stamps: ns, of the frames whose place in the map was known. poses: T_map_lidar (4, 4) of each of them.
    """

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.poses: list[Array] = []
        self._frames: Counter[State] = Counter()
        self._first: int | None = None
        self._events: list[dict[str, Any]] = []

    def add(self, system: LocalizationSystem, frame: Frame) -> str:
        """Take the next frame through the system; returns what is worth telling of it, or nothing."""
        before = system.localizer.state
        tracked, located = system.process(frame)
        state = State.LOST if tracked.state is State.LOST else system.localizer.state
        number = self._frames.total()
        self._frames[state] += 1
        if state.located:
            self.stamps.append(frame.stamp)
            self.poses.append(system.localizer.T_map_odom @ tracked.T_odom_lidar)
        if located is None or located.state is before or located.state is State.TRACKING:
            return ""
        kind = "kidnapped" if located.jumped and before.located else "found" if located.jumped else str(located.state)
        if located.jumped and self._first is None:
            self._first = number
        event = {"frame": frame.index, "stamp_ns": frame.stamp, "event": kind, "reason": located.registration.reason}
        if located.jumped:
            event["position_m"] = located.T_map_kf[:3, 3].round(3).tolist()
        self._events.append(event)
        return f"frame {frame.index}: {kind} {event.get('position_m', '')}{located.registration.reason}"

    def summary(self) -> dict[str, Any]:
        """Counts of frames by state, how many passed until the first answer (None: there was none), and events."""
        return {
            "frames": self._frames.total(),
            "frames_until_found": self._first,
            "frames_located": len(self.stamps),
            "frames_by_state": {str(state): count for state, count in sorted(self._frames.items())},
            "kidnappings": sum(event["event"] == "kidnapped" for event in self._events),
            "events": self._events,
        }


def run_localized(
    source: Source, span: tuple[int, int], out: Path, map_file: Path, hint: Array | None, chosen: Config
) -> None:
    """The drive through a map: localisation.json, trajectory.tum of the frames whose place was known, config.yaml.

    Raises:
        UsageError: no map to find oneself in.
    """
    console, report = Console(stderr=True), LocalizationReport()
    with open_for_localization(map_file, chosen.slam) as store:
        system = LocalizationSystem(chosen.slam, store)
        if hint is not None:
            system.localizer.hint(hint)
        out.mkdir(parents=True, exist_ok=True)
        with progress_bar(console) as progress:
            task = progress.add_task(source.name, total=span[1] - span[0])
            try:
                for frame in prefetch(source.frames(*span)):
                    if info := report.add(system, frame):
                        progress.console.print(info, soft_wrap=True)
                    progress.update(task, advance=1, description=f"{source.name} {system.localizer.state}")
            except KeyboardInterrupt:
                console.print("interrupted; writing what there is", style="yellow")
    write_tum(out / "trajectory.tum", report.stamps, np.array(report.poses).reshape(-1, 4, 4))
    summary = report.summary()
    for name, text in (
        ("config.yaml", dump_settings(chosen)),
        ("localisation.json", json.dumps(summary, indent=2) + "\n"),
    ):
        with atomic_write(out / name) as file:
            file.write(text)
    until = summary["frames_until_found"]
    found = "not found" if until is None else f"found after {until} frames"
    Console().print(
        f"{source.name} in {map_file.name}: {found}, place known in {len(report.stamps)} of {summary['frames']} frames"
        f"; results in {out}",
        soft_wrap=True,
    )
