# SPDX-License-Identifier: Apache-2.0
"""`dpm2 run`: run the SLAM on a recording at full speed, without ROS.

Modules that do the work are imported in the functions that need them, so that `--help` and shell completion are fast.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpm2_core.commands.options import ConfigFile, JsonFile, Overrides, note, show
from dpm2_core.config import load_settings
from dpm2_core.console import progress_bar
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import make_folder
from dpm2_core.interrupt import interrupt_deferred

if TYPE_CHECKING:
    from dpm2_core.data.source import Source
    from dpm2_core.evaluation.run_result import Result
    from dpm2_core.pipeline import OfflineRun, Watch
    from dpm2_core.slam.session import MapMode
    from dpm2_core.slam.settings import Config
    from dpm2_core.slam.system import SlamResult


def run(
    src: Annotated[
        Path,
        typer.Argument(help="Recording: KITTI, a ROS 2 or ROS 1 bag, PCD or PLY files, ...; see docs/recordings.md."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    gt: Annotated[
        Path | None,
        typer.Option(
            help="Ground truth: a file of poses (KITTI: of the left camera; TUM: of the LiDAR). Default: that of the "
            "recording, if it has one."
        ),
    ] = None,
    frames: Annotated[str, typer.Option(help="Frames a to b - 1, as a:b, counted from 0; `:` is all.")] = ":",
    corrupt: Annotated[
        str | None,
        typer.Option(
            help="Simulate sensor failures, NAME=VALUE,...: camera (black images), no_image, overexposed, "
            "underexposed, obstruction (a box in front of the LiDAR), as fractions of the frames; stops (of the "
            "exposure); beams (dead ones) and dust (pulses that return from it), as fractions; sight (largest range, "
            "m); extrinsic_deg, extrinsic_m (errors of the extrinsics); time_offset (delay of the images, s); seed."
        ),
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="Map file to write during the run, such as drive.dpm2map. Default: none."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run of the same drive from the end of --map.")
    ] = False,
    extend: Annotated[bool, typer.Option("--extend", help="Add this drive to the map of other drives, --map.")] = False,
    localise: Annotated[
        Path | None,
        typer.Option("--localise", help="Localize the drive in this map (a file or tiles) and do not change the map."),
    ] = None,
    hint: Annotated[
        str | None,
        typer.Option(
            help="Approximate first pose in the map of --localise: x,y,yaw in m and degrees, such as 12,-3,90."
        ),
    ] = None,
    config: ConfigFile = None,
    settings: Overrides = None,
    view: Annotated[bool, typer.Option("--view", help="Show the run live in rerun's viewer.")] = False,
    record: Annotated[
        Path | None, typer.Option(help="Write what --view shows to a file, such as run.rrd: `rerun run.rrd` shows it.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Run the SLAM on a recording and write trajectory, map, image, timing and metrics."""
    from dpm2_core.commands.localise import parse_hint, run_localized
    from dpm2_core.data.corrupt import CorruptedSource, parse_corruption
    from dpm2_core.data.source import parse_range
    from dpm2_core.pipeline import OfflineRun, open_recording
    from dpm2_core.slam.settings import Config

    chosen = load_settings(Config, config, settings or [])
    corruption = None if corrupt is None else parse_corruption(corrupt)
    span = parse_range(frames)
    if resume and extend:
        raise UsageError("--resume continues the same drive, --extend adds another one: give only one of them")
    if (resume or extend) and map_file is None:
        raise UsageError(f"--{'resume' if resume else 'extend'}: needs the map, --map FILE")
    if localise is not None and (gt is not None or map_file is not None):
        raise UsageError("--localise: writes no map, and its poses are in the frame of the map: omit --map and --gt")
    if localise is not None and (view or record is not None):
        raise UsageError("--view, --record: they show how a map is made; they do not work with --localise")
    if localise is None and hint is not None:
        raise UsageError("--hint: works only with --localise")
    T_hint = None if hint is None else parse_hint(hint)
    if view or record is not None:
        from dpm2_core.evaluation.live_view import check_view

        check_view(view, record, out)
    source: Source | Path = src
    if corruption is not None:
        needs_images = (
            chosen.slam.registration != "geometric" or chosen.slam.visual.enabled or chosen.slam.map.thumbnail > 0
        )
        source = CorruptedSource(open_recording(src, chosen, needs_images), corruption)
    if localise is not None:
        with OfflineRun(source, chosen, span, map_file=localise, map_mode="localize") as drive, interrupt_deferred():
            found, figures = run_localized(drive, out, T_hint, chosen)
            show(found, figures, json_file)
        if problem := figures["map_unreadable"]:
            raise Dpm2Error(f"parts of the map cannot be read: {problem}")
        return
    mode: MapMode = "resume" if resume else "extend" if extend else "create"
    with OfflineRun(source, chosen, span, gt, map_file, mode) as drive:
        make_folder(out)  # --record may write into it
        if resume:
            _set_results_aside(drive, out)
        _run_mapping(drive, chosen, out, (view, record), json_file)


def _set_results_aside(drive: OfflineRun, out: Path) -> None:
    """Move the results of the interrupted run to a subfolder, so that this run does not replace them."""
    from dpm2_core.evaluation.run_folder import TRAJECTORY, set_aside

    if (out / TRAJECTORY).exists():
        first = drive.slam.mapper.keyframes[-1].index if drive.slam.mapper.keyframes else 0
        folder = set_aside(out, f"before_{first}")
        note(f"{folder}: the results of the interrupted run; this run begins at frame {first}")


def _run_mapping(
    drive: OfflineRun, config: Config, out: Path, shown: tuple[bool, Path | None], json_file: Path | None
) -> None:
    """Run the drive and write its results; `shown`: whether in a viewer, and to which file."""
    from dpm2_core.evaluation.live_view import LiveView
    from dpm2_core.evaluation.run_folder import TRAJECTORY
    from dpm2_core.evaluation.run_result import save_config

    with ExitStack() as stack:
        view, record = shown
        live = None
        if view or record is not None:
            live = stack.enter_context(LiveView(drive.source.name, view, record))
        if not (out / TRAJECTORY).exists():  # else keep the config.yaml of the earlier results until they are replaced
            save_config(config, out)  # before the run, so that a failed run has its configuration, too
        with interrupt_deferred():  # after the drive, too: an interrupt would lose its results
            _report(_run_drive(drive, None if live is None else live.add), out, json_file)


def _run_drive(drive: OfflineRun, watch: Watch | None) -> Result:
    """Run the drive with a progress bar; failures are printed immediately."""
    name, problem, seen = drive.source.name, "", ""
    with progress_bar() as bar:
        task = bar.add_task(name, total=len(drive))

        def progress(result: SlamResult) -> None:
            nonlocal problem, seen
            tracked = result.odometry
            if (now := drive.slam.mapper.store_problem) and not problem:
                bar.console.print(f"map file: {now}", style="red", soft_wrap=True)
            problem = now
            if tracked.failed:
                bar.console.print(
                    f"frame {tracked.index}: {tracked.registration.reason}", style="yellow", soft_wrap=True
                )
            if (scale := drive.slam.odometry.scale) != seen:
                bar.console.print(f"frame {tracked.index}: slam.preset auto: {scale}", soft_wrap=True)
                seen = scale
            bar.update(task, advance=1, description=f"{name} {tracked.state}")

        return drive.run(progress, watch)


def _report(result: Result, out: Path, json_file: Path | None) -> None:
    """Write the result files, and print the outcome.

    Raises:
        Dpm2Error: the map file is not complete.
    """
    from dpm2_core.evaluation.report import metrics_table

    source = result.source
    if result.interrupted:
        note(f"interrupted after {len(result)} frames; writing their results", "yellow")
    for text in source.notes:
        note(text, "yellow")
    imu_problems = {f"IMU: {problem}": count for problem, count in result.imu.items() if problem != "used"}
    for problem, count in (imu_problems | result.problems).items():
        note(f"{problem} ({count} of {len(result)} frames)", "yellow")
    if not result.connected:
        note("no place of this drive was found in the map: its poses are in a frame of its own", "yellow")
    for missing in result.save(out):
        note(missing)
    metrics, title = result.metrics, f"{source.name}, {len(result)} frames"
    shown = "" if metrics is None else metrics_table(metrics, title=title, frame=result.sensor)
    figures = {"source": source.name, **result.timing, "metrics": None if metrics is None else metrics.model_dump()}
    show(shown, figures, json_file)
    note(f"Results in {out}")
    if problem := result.mapper.store_problem:
        raise Dpm2Error(f"map file incomplete: {problem}")
