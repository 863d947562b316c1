# SPDX-License-Identifier: Apache-2.0
"""`dpm2 eval`: evaluate a trajectory file against ground truth, and print how it was evaluated.

Modules that do the work are imported in the functions that need them, so that `--help` and shell completion are fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpm2_core.commands.options import InputOverrides, JsonFile, note, parse_lengths, show
from dpm2_core.errors import UsageError

if TYPE_CHECKING:
    from dpm2_core.data.trajectory import Trajectory

FRAME_AS_GIVEN = "as in the files; both must be poses of the same sensor"
FRAME_CAMERA = "left camera; the estimate, poses of the LiDAR, was converted with Tr of the calibration"
OTHER_AXES = (
    "the trajectories have the same shape, but the axes of their poses differ, as those of LiDAR and left camera do "
    "(--calib converts the estimate), or one has no rotations: then only APE is meaningful"
)
UNESTIMATED = "without a pose in the estimate"
FRAME_OF_DRIVE = "{}, as in the files of this kind that dpm2 run writes"


def eval_(
    gt: Annotated[
        Path,
        typer.Option(
            help="Ground truth: a KITTI, KITTI-360 or TUM trajectory file, or a drive with known poses. A drive's "
            "poses are those of its LiDAR for a TUM estimate, else those of its left camera."
        ),
    ],
    est: Annotated[Path, typer.Option(help="Estimated trajectory: a file in one of the same formats.")],
    json_file: JsonFile = None,
    lengths: Annotated[
        str | None,
        typer.Option(help="Segment lengths of the KITTI metric, m, such as 10,20,30,40,50. Default: 100 to 800."),
    ] = None,
    calib: Annotated[
        Path | None,
        typer.Option(
            help="KITTI calib.txt. Give it if the estimate has poses of the LiDAR and the ground truth poses of the "
            "left camera: the estimate is then converted."
        ),
    ] = None,
    settings: InputOverrides = None,
) -> None:
    """Evaluate a trajectory: KITTI metric, APE, RPE and final drift."""
    from dpm2_core.data.open import is_drive
    from dpm2_core.data.trajectory import matched, read_trajectory, stamps_of
    from dpm2_core.evaluation.kitti_metric import OFFICIAL_LENGTHS, known
    from dpm2_core.evaluation.metrics import evaluate, have_other_axes
    from dpm2_core.evaluation.report import metrics_table

    if settings and not is_drive(gt):
        raise UsageError(f"--set {settings[0]}: applies only if --gt is a drive, and {gt} is not one")
    segment_lengths = parse_lengths(lengths) if lengths else OFFICIAL_LENGTHS
    estimate, frame = read_trajectory(est), FRAME_AS_GIVEN
    if is_drive(gt):
        stamped = estimate.kind == "tum"
        truth, sensor = _drive_truth(gt, settings or [], stamped, lidar=stamped and calib is None)
        frame = FRAME_OF_DRIVE.format(sensor)
    else:
        truth = read_trajectory(gt)
    if calib is not None:
        estimate, frame = in_camera_frame(estimate, calib), FRAME_CAMERA
    true, est_poses, keys = matched(truth, estimate)
    stamps = keys if "tum" in (truth.kind, estimate.kind) else stamps_of(keys)
    metrics = evaluate(true, est_poses, segment_lengths, stamps=stamps).model_copy(update={"truth": str(gt)})
    figures = {"gt": str(gt), "est": str(est), "frame": frame, **metrics.model_dump()}
    common = known(true) & known(est_poses)
    if have_other_axes(true[common], est_poses[common]):
        note(OTHER_AXES)
    table = metrics_table(metrics, title=f"{est} against {gt}", frame=frame, failed=UNESTIMATED)
    show(table, figures, json_file)


def _drive_truth(path: Path, settings: list[str], stamped: bool, lidar: bool) -> tuple[Trajectory, str]:
    """Ground truth of all frames of a drive, NaN for frames without a pose, and the name of the sensor.

    As in the files that `dpm2 run` writes, keys are stamps or frame numbers, and poses those of the LiDAR, or of the
    left camera if its extrinsics are known."""
    import numpy as np

    from dpm2_core.data.open import open_source
    from dpm2_core.data.settings import input_settings
    from dpm2_core.data.trajectory import Trajectory
    from dpm2_core.evaluation.ground_truth import camera_poses
    from dpm2_core.evaluation.kitti_metric import known

    source = open_source(path, input_settings([*settings, "input.images=false"]))
    if source.poses is None:
        raise UsageError(f"{path}: the drive has no ground truth")
    if not known(source.poses).any():
        raise UsageError(f"{path}: no frame has a pose; {'; '.join(source.notes)}")
    camera = None if lidar else source.T_cam_lidar
    poses = camera_poses(source.poses, camera)
    sensor = "LiDAR" if camera is None else "left camera"
    if stamped:
        stamps = getattr(source, "stamps", None)  # some sources have stamps only in their frames
        stamps = [frame.stamp for frame in source.frames()] if stamps is None else stamps
        return Trajectory(poses, np.array(stamps, np.int64), "tum"), sensor
    numbers = getattr(source, "numbers", None)  # numbers in the file names
    numbers = np.arange(len(source)) if numbers is None else numbers
    # Keep frames without a pose: a file with a line for each frame is matched line by line.
    return Trajectory(poses, numbers, "kitti-indexed"), sensor


def in_camera_frame(trajectory: Trajectory, calib: Path) -> Trajectory:
    """Convert LiDAR poses to poses of the left camera. The world frame is kept; alignment compensates for that."""
    from dpm2_core.data.kitti import read_calib
    from dpm2_core.data.trajectory import Trajectory
    from dpm2_core.geometry import se3

    if not calib.is_file():
        raise UsageError(f"{calib}: no such file")
    T_cam_lidar = read_calib(calib).get("Tr")
    if T_cam_lidar is None:
        raise UsageError(f"{calib}: no Tr, the transform from the LiDAR to the left camera")
    return Trajectory(trajectory.poses @ se3.inverse(T_cam_lidar), trajectory.keys, trajectory.kind)
