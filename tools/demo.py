# SPDX-License-Identifier: Apache-2.0
"""`make demo`: a drive through bag, player and slam_node, checked and plotted. Without a drive, one is simulated."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from dpm2_core.commands.options import run_command
from dpm2_core.console import Console, progress_bar
from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import convert
from dpm2_core.data.open import is_rosbag2, open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.trajectory import read_trajectory
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.figures import trajectory_png
from dpm2_core.evaluation.metrics import evaluate
from dpm2_core.extras import MissingPackageError
from dpm2_core.files import write_json
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.slam.output import corrected
from dpm2_core.tables import FigureTable
from dpm2_ros.tf_message import TFMessage
from tools.replay import Replay, replay

QUEUE = 50
"""Queue depth of slam_node here: if the machine stalls for a moment, latency rises but no cloud is lost."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures (the content of summary.json), and the checks: text to whether it passed."""

    summary: dict[str, float | int | None]
    checks: dict[str, bool]


def demo(
    src: Annotated[
        Path | None, typer.Argument(help="KITTI sequence, rosbag2 folder or .mcap; default: simulated")
    ] = None,
    out: Annotated[Path, typer.Option(help="folder for all output")] = Path("out/demo"),
    rate: Annotated[float, typer.Option(help="playing speed, relative to the recording", min=0.05)] = 1.0,
) -> int:
    """Replay a drive into slam_node and check its output. Exit code 1 if a check fails."""
    console = Console()
    out.mkdir(parents=True, exist_ok=True)
    bag = prepare(src, out, console)
    source = BagSource(bag, InputSettings(images=False))
    with progress_bar(console) as progress:
        task = progress.add_task("bag_player -> slam_node -> /dpm2/odom", total=len(source))
        parameters = {"ros.queue_depth": QUEUE, "ros.map_period": 2.0}
        result = replay(source, out, rate, parameters, lambda done: progress.update(task, completed=done))
    evaluation = evaluate_replay(source, result, out)
    write_json(out / "summary.json", evaluation.summary)
    console.print(_table(source, result, evaluation, out))
    failed = [check for check, holds in evaluation.checks.items() if not holds]
    for check in failed:
        console.print(f"failed: {check}", style="red")
    if failed:
        console.print(f"logs: {out / 'slam_node.log'}, {out / 'bag_player.log'}")
    return 1 if failed else 0


def prepare(src: Path | None, out: Path, console: Console) -> Path:
    """The bag to play: `src` itself, another recording converted, or a simulated one; earlier output is reused.

    Raises:
        UsageError: `src` cannot be read.
    """
    if src is not None and not src.exists():
        raise UsageError(f"{src}: no such file or folder")
    if src is not None and is_rosbag2(src):
        return src
    if src is None:
        src = out / "city"
        if not src.is_dir():  # the folder exists only when it is complete
            _simulate(src)
    bag = out / f"bag_{src.resolve().name}"
    made_from = bag.with_suffix(".source")  # a drive of the same name in another folder is a different one
    if not (bag / "metadata.yaml").is_file() or made_from.read_text() != str(src.resolve()):
        with console.status(f"converting {src} to {bag}"):
            for note in convert(open_source(src), bag, overwrite=True):
                console.print(note, style="yellow")
        made_from.write_text(str(src.resolve()))
    return bag


def _simulate(out: Path) -> None:
    command = ["sim", str(out), "--seed", "7"]  # 15 s around a loop
    if subprocess.run([sys.executable, "-m", "dpm2_core.cli", *command], check=False).returncode:
        raise Dpm2Error(f"dpm2 {' '.join(command)} failed")


def evaluate_replay(source: BagSource, result: Replay, out: Path) -> Evaluation:
    """Compare output with input, and with the ground truth if there is any; draws the image."""
    stamps = source.stamps
    found = [stamp for stamp in dict.fromkeys(stamps.tolist()) if stamp in result.poses]
    summary: dict[str, float | int | None] = {
        "frames_in": len(result.published),
        "frames_out": len(result.poses),
        "dropped": len(result.published) - len(found),
        "latency_p50_ms": None,
        "latency_p95_ms": None,
        "ape_rmse_m": None,
        "rpe_trans_m": None,
        "rpe_rot_deg": None,
        "loops": result.loops,
    }
    published = dict(zip(stamps.tolist(), result.published.tolist(), strict=False))
    latency = [(result.received[stamp] - published[stamp]) * 1e-6 for stamp in found if stamp in published]
    if latency:
        summary["latency_p50_ms"], summary["latency_p95_ms"] = np.percentile(latency, [50, 95]).round(2).tolist()
    checks = {
        "every cloud has its odometry, with the same stamp": len(found) == len(result.published) > 0,
        "no odometry without its cloud": len(found) == len(result.poses),
        "the map arrived, with points in it": result.map is not None and len(result.map) > 0,
        "the map was saved": result.saved is not None,
        "/diagnostics arrived": bool(result.diagnostics),
        "slam_node and bag_player ended cleanly": set(result.exit_codes.values()) == {0},
    }
    if TFMessage is not None:
        requested = {f"odom -> {result.base_frame}", "map -> odom"}
        checks["/tf has odom -> base and map -> odom"] = requested <= result.tf
    if len(found) > 1:
        _check_poses(source, result, out, found, summary, checks)
    return Evaluation(summary, checks)


def _check_poses(
    source: BagSource,
    result: Replay,
    out: Path,
    found: list[int],
    summary: dict[str, float | int | None],
    checks: dict[str, bool],
) -> None:
    stamps = source.stamps.tolist()
    position = {stamp: n for n, stamp in reversed(list(enumerate(stamps)))}
    rows = [position[stamp] for stamp in found]
    est = np.full((len(stamps), 4, 4), np.nan)
    est[rows] = map_poses(source, result, found)
    truth = source.poses
    if truth is not None and np.isfinite(truth[:, 0, 0]).sum() > 1:
        metrics = evaluate(truth, est)
        summary["ape_rmse_m"] = metrics.ape_rmse_m
        summary["rpe_trans_m"], summary["rpe_rot_deg"] = metrics.rpe_trans_m, metrics.rpe_rot_deg
        if metrics.ape_rmse_m is not None and metrics.path_length_m is not None:
            checks["the trajectory is right to 1 % of its length"] = metrics.ape_rmse_m < 0.01 * metrics.path_length_m
    true_poses = None if truth is None else truth[rows]
    try:
        trajectory_png(
            out / "trajectory.png", est[rows], true_poses, result.map, title=f"{source.name}: {len(found)} frames"
        )
    except MissingPackageError as error:
        typer.echo(f"no trajectory.png: {error}", err=True)


def map_poses(source: BagSource, result: Replay, found: list[int]) -> Array:
    """(N, 4, 4) poses of the LiDAR for the stamps `found`, with the corrections of the saved map's keyframes."""
    T_odom_base = np.array([result.poses[stamp] for stamp in found])
    if result.saved is not None:
        keyframes = read_trajectory(result.saved / "trajectory.tum")
        position = {stamp: n for n, stamp in enumerate(found)}
        known = [n for n, stamp in enumerate(keyframes.keys.tolist()) if stamp in position]
        indices = np.array([position[keyframes.keys[n]] for n in known], np.intp)
        T_odom_base = corrected(T_odom_base, indices, keyframes.poses[known] @ se3.inverse(T_odom_base[indices]))
    if result.base_frame == source.lidar_frame:
        return T_odom_base
    T_base_lidar = source.transforms.lookup(result.base_frame, source.lidar_frame)
    return se3.inverse(T_base_lidar) @ T_odom_base @ T_base_lidar


def _table(source: BagSource, result: Replay, evaluation: Evaluation, out: Path) -> FigureTable:
    s = evaluation.summary
    title = f"{source.name} through ROS 2"
    table = FigureTable(title, names=["what"], figures=["value"], text=["how"], header=False)
    table.add_row("clouds in", str(s["frames_in"]), f"{source.points_topic}")
    table.add_row("poses out", str(s["frames_out"]), "/dpm2/odom, of the same stamp")
    table.add_row("dropped", str(s["dropped"]), f"queue of {QUEUE}; the node counts {_diagnostic(result, 'dropped')}")
    table.add_row("latency p50", _value(s["latency_p50_ms"], "ms", 1), "cloud published to odometry received")
    table.add_row("latency p95", _value(s["latency_p95_ms"], "ms", 1), "")
    table.add_row("APE rmse", _value(s["ape_rmse_m"], "m", 3), "positions after SE(3) alignment, LiDAR frame")
    table.add_row("RPE translation", _value(s["rpe_trans_m"], "m", 4), "mean of frame to frame")
    table.add_row("RPE rotation", _value(s["rpe_rot_deg"], "deg", 4), "")
    table.add_row("keyframes, loops", f"{len(result.keyframes)}, {s['loops']}", "/dpm2/keyframe, /dpm2/loop_closure")
    table.add_row(
        "map", f"{0 if result.map is None else len(result.map)}", f"points in the last of {result.maps} /dpm2/map"
    )
    table.add_row("checks", f"{sum(evaluation.checks.values())} of {len(evaluation.checks)}", "hold")
    table.add_row("files", "", f"{result.saved}\n{out / 'summary.json'}\n{out / 'trajectory.png'}")
    return table


def _diagnostic(result: Replay, key: str) -> str:
    return next((value for name, value in result.diagnostics.items() if name.startswith(key)), "-")


def _value(value: float | int | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}"


if __name__ == "__main__":
    sys.exit(run_command(demo))
