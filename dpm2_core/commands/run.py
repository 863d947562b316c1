# SPDX-License-Identifier: Apache-2.0
"""`dpm2 run`: a recording through the SLAM at full speed, without ROS."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dpm2_core.commands.localise import parse_hint, run_localized
from dpm2_core.config import dump_settings, load_settings
from dpm2_core.console import Console
from dpm2_core.data.corrupt import CorruptedSource, CorruptionSettings, parse_corruption
from dpm2_core.data.open import open_source
from dpm2_core.data.ply import write_ply
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.source import Source
from dpm2_core.data.trajectory import Trajectory, matched, read_trajectory, write_kitti, write_tum
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.metrics import Metrics, evaluate
from dpm2_core.evaluation.report import metrics_table
from dpm2_core.extras import MissingPackageError
from dpm2_core.files import atomic_write
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.output import TrajectoryRecorder
from dpm2_core.slam.session import open_session, resume_at
from dpm2_core.slam.settings import Config
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.system import SlamSystem

ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file; `dpm2 config dump` shows every key.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, such as slam.map.voxel=0.3.")]


def run(
    src: Annotated[Path, typer.Argument(help="KITTI odometry sequence or root, rosbag2 folder, .mcap or .db3 file.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    gt: Annotated[Path | None, typer.Option(help="Ground truth (KITTI: left camera; TUM: LiDAR).")] = None,
    frames: Annotated[str, typer.Option(help="Which frames, a:b by position from 0.")] = ":",
    no_image: Annotated[bool, typer.Option("--no-image", help="Leave the camera out.")] = False,
    corrupt: Annotated[
        str | None,
        typer.Option(
            help="Let sensors fail, NAME=VALUE,...: fractions of frames camera (black), no_image, overexposed, "
            "underexposed (by stops), obstruction; fraction of beams; extrinsic_deg, extrinsic_m, time_offset (s); "
            "seed."
        ),
    ] = None,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="Map file, such as drive.dpm2map, written as the drive goes on.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where --map ends: a run was cut off.")] = False,
    extend: Annotated[bool, typer.Option("--extend", help="Add this drive, another one, to --map.")] = False,
    localise: Annotated[
        Path | None, typer.Option("--localise", help="Find the drive in this map file, which stays as it is.")
    ] = None,
    hint: Annotated[
        str | None, typer.Option(help="About where in --localise it begins: x,y,yaw in m and degrees.")
    ] = None,
    config: ConfigFile = None,
    settings: Overrides = None,
) -> None:
    """Run the SLAM on a recording and write trajectory, map, image, timing and metrics."""
    overrides = [*(settings or []), *(["input.images=false"] if no_image else [])]
    chosen = load_settings(Config, config, overrides)
    corruption = None if corrupt is None else parse_corruption(corrupt)
    span = parse_range(frames)
    if resume and extend:
        raise UsageError("--resume goes on with the same drive, --extend adds another one: not both")
    if (resume or extend) and map_file is None:
        raise UsageError(f"--{'resume' if resume else 'extend'}: in which map? give --map FILE")
    if localise is not None:
        if gt is not None or map_file is not None:
            raise UsageError("--localise: the map stays as it is, and its frame is its own: without --map and --gt")
        T_hint = None if hint is None else parse_hint(hint)
        source, start, stop = _open(src, span, corruption, chosen, chosen.slam.registration != "geometric")
        run_localized(source, (start, stop), out, localise, T_hint, chosen)
        return
    if hint is not None:
        raise UsageError("--hint: only with --localise")
    console = Console(stderr=True)
    store = None
    if map_file is not None:
        store = open_session(map_file, chosen.slam, dump_settings(chosen), resume or extend)
    with nullcontext() if store is None else store:
        _run(src, out, gt, span, corruption, chosen, store, resume, console)


def _run(
    src: Path,
    out: Path,
    gt: Path | None,
    span: tuple[int, int | None],
    corruption: CorruptionSettings | None,
    chosen: Config,
    store: MapStore | None,
    resume: bool,
    console: Console,
) -> None:
    """The drive, when it is clear what is wanted."""
    system, recorder = SlamSystem(chosen.slam, store=store), TrajectoryRecorder()
    source, start, stop = _open(
        src, span, corruption, chosen, system.odometry.uses_images or chosen.slam.map.thumbnail > 0
    )
    if resume:
        start = resume_at(system.mapper, source, start)
        _check_span(span, start, stop, source, src)
    truth = _ground_truth(source, gt, start, stop)
    out.mkdir(parents=True, exist_ok=True)
    with atomic_write(out / "config.yaml") as file:
        file.write(dump_settings(chosen))
    seconds, results, wall = _drive(source, start, stop, system, recorder, console)
    for note in source.notes:
        console.print(note, style="yellow", soft_wrap=True)
    system.mapper.finish()
    first = system.mapper.session_start
    if first > 0 and not any(a < first <= b for a, b, _, _ in system.mapper.edges):
        console.print("no place of this drive was found in the map: it stands in a frame of its own", style="yellow")
    if problem := system.mapper.store_problem:
        console.print(f"map file incomplete: {problem}", style="red", soft_wrap=True)
    of_truth = truth, source.truth if gt is None else str(gt)
    metrics = _write(out, source, system, recorder, of_truth, results, seconds, wall)
    if metrics is not None:
        sensor = "LiDAR" if source.T_cam_lidar is None else "left camera"
        Console().print(metrics_table(metrics, title=f"{source.name}, {len(recorder)} frames", frame=sensor))
    console.print(f"Results in {out}", soft_wrap=True)


def _open(
    src: Path, span: tuple[int, int | None], corruption: CorruptionSettings | None, chosen: Config, images: bool
) -> tuple[Source, int, int]:
    """The recording, and the first of its frames and the one after the last; `images` False leaves those out.

    Raises:
        UsageError: no such recording, or no frames in that span.
    """
    # Decoding images that nobody looks at would only cost time.
    source = open_source(src, chosen.input.model_copy(update={"images": images and chosen.input.images}))
    if corruption is not None:
        source = CorruptedSource(source, corruption)
    stop = len(source) if span[1] is None else min(span[1], len(source))
    _check_span(span, span[0], stop, source, src)
    return source, span[0], stop


def _check_span(span: tuple[int, int | None], start: int, stop: int, source: Source, src: Path) -> None:
    if start >= stop:
        raise UsageError(f"--frames {span[0]}:{'' if span[1] is None else span[1]}: {src} has {len(source)} frames")


def parse_range(text: str) -> tuple[int, int | None]:
    """`a:b`, `a:`, `:b` or `:` to (a, b or None)."""
    first, colon, last = text.partition(":")
    if not colon or not all(part.isdecimal() or not part for part in (first, last)):
        raise UsageError(f"--frames {text}: want a:b, such as 0:100")
    return int(first or 0), int(last) if last else None


def _drive(
    source: Source, start: int, stop: int, system: SlamSystem, recorder: TrajectoryRecorder, console: Console
) -> tuple[dict[str, list[float]], Counter[str], float]:
    """All frames through the system: seconds per stage and frame, who answered how often, wall time in s.

    Ctrl-C ends it early.
    """
    seconds: dict[str, list[float]] = {}
    results: Counter[str] = Counter()
    problem = ""  # of the map file
    began = perf_counter()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(source.name, total=stop - start)
        try:
            for frame in prefetch(source.frames(start, stop)):
                tracked = system.process(frame)
                recorder.add(tracked)
                if (now := system.mapper.store_problem) and not problem:
                    progress.console.print(f"map file: {now}", style="red", soft_wrap=True)
                problem = now
                for stage, time in tracked.seconds.items():
                    seconds.setdefault(stage, []).append(time)
                results[tracked.registration.method if tracked.registration.ok else "failed"] += 1
                if not tracked.registration.ok:
                    progress.console.print(
                        f"frame {frame.index}: {tracked.registration.reason}", style="yellow", soft_wrap=True
                    )
                progress.update(task, advance=1, description=f"{source.name} {tracked.state}")
        except KeyboardInterrupt:
            console.print(f"interrupted after {len(recorder)} frames; writing what there is", style="yellow")
    return seconds, results, perf_counter() - began


def _ground_truth(source: Source, gt: Path | None, start: int, stop: int) -> Array | Trajectory | None:
    """Poses of the processed frames (LiDAR frame), or a trajectory to be matched by stamp; None without any."""
    if gt is None:
        return None if source.poses is None else source.poses[start:stop]
    truth = read_trajectory(gt)
    if truth.kind == "tum" or truth.kind == "kitti-indexed":
        return truth
    requested = range(start, stop)
    if len(truth) < len(source):
        raise UsageError(f"{gt}: {len(truth)} poses for {len(source)} frames of {source.name}")
    if len(truth) > len(source):  # a file of the whole sequence beside an excerpt: KITTI's frame numbers tell
        wanted_numbers = [frame.index for frame in source.frames(start, stop)]
        if max(wanted_numbers) >= len(truth):
            raise UsageError(f"{gt}: {len(truth)} poses, but {source.name} has frame {max(wanted_numbers)}")
        poses = truth.poses[wanted_numbers]
    else:
        poses = truth.poses[list(requested)]
    return poses if source.T_cam_lidar is None else _in_other_frame(poses, se3.inverse(source.T_cam_lidar))


def _in_other_frame(poses: Array, T_other_sensor: Array) -> Array:
    """Poses of one sensor as those of another that is rigidly mounted to it."""
    return T_other_sensor @ poses @ se3.inverse(T_other_sensor)


def _write(
    out: Path,
    source: Source,
    system: SlamSystem,
    recorder: TrajectoryRecorder,
    of_truth: tuple[Array | Trajectory | None, str],
    results: Counter[str],
    seconds: dict[str, list[float]],
    wall: float,
) -> Metrics | None:
    """All result files; the metrics when there is ground truth, given with what it was read from."""
    from dpm2_core.evaluation.figures import trajectory_png

    poses = recorder.poses(system.mapper.poses[system.mapper.session_start :])
    sensor = poses if source.T_cam_lidar is None else _in_other_frame(poses, source.T_cam_lidar)
    write_kitti(out / "trajectory_kitti.txt", sensor)
    write_tum(out / "trajectory.tum", recorder.stamps, poses)
    cloud = system.mapper.cloud()
    write_ply(out / "map.ply", cloud)
    system.mapper.write_g2o(out / "pose_graph.g2o")
    total = np.sum(list(seconds.values()), axis=0)
    fps = len(total) / float(total.sum()) if len(total) else 0.0
    stages = {stage: _summary(times) for stage, times in [*seconds.items(), ("total", total.tolist())]}
    timing = {"frames": len(recorder), "fps": fps, "wall_s": wall, "answers": dict(results), "stages_ms": stages}
    _write_json(out / "timing.json", timing)
    metrics, failed, (truth, truth_name) = None, results["failed"], of_truth
    if isinstance(truth, Trajectory):
        own = Trajectory(poses, np.array(recorder.stamps), "tum")
        if truth.kind == "kitti-indexed":
            own = Trajectory(sensor, np.array(recorder.index), "kitti-indexed")
        truth, poses = matched(truth, own)
        metrics = evaluate(truth, poses, failed_frames=failed, breaks=recorder.breaks, fps=fps)
    elif truth is not None and np.isfinite(truth[: len(poses), 0, 0]).sum() >= 2:
        truth = truth[: len(poses)]
        T = source.T_cam_lidar
        checked = truth if T is None else _in_other_frame(truth, T)
        metrics = evaluate(checked, sensor, failed_frames=failed, breaks=recorder.breaks, fps=fps)
    if metrics is not None:
        metrics = metrics.model_copy(update={"truth": truth_name})
        _write_json(out / "metrics.json", metrics.model_dump())
    try:
        trajectory_png(out / "trajectory.png", poses, truth, cloud, title=f"{source.name}: {len(recorder)} frames")
    except MissingPackageError as error:
        typer.echo(f"no trajectory.png: {error}", err=True)
    return metrics


def _summary(times: list[float]) -> dict[str, float]:
    median, p95 = np.percentile(np.array(times) * 1e3, [50, 95]) if times else (0.0, 0.0)
    return {"median": round(float(median), 3), "p95": round(float(p95), 3)}


def _write_json(path: Path, content: object) -> None:
    with atomic_write(path) as file:
        file.write(json.dumps(content, indent=2) + "\n")
