# SPDX-License-Identifier: Apache-2.0
"""`dpm2 sim`: a drive through the synthetic city."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from dpm2_core.commands.options import PROCESSORS, Workers, note
from dpm2_core.config import settings_from
from dpm2_core.console import counted
from dpm2_core.sim.sensors import real_sensor
from dpm2_core.sim.settings import DriveConfig, PresetName


def sim(
    out: Annotated[
        Path,
        typer.Argument(
            help="Folder to write, in KITTI odometry layout. If it contains this drive already, it is kept."
        ),
    ],
    frames: Annotated[
        int | None,
        typer.Option(
            help="Number of frames, at 10 Hz. Default: 150, or all poses of the file --road.", show_default=False
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed of the world and of the noise.")] = 0,
    road: Annotated[
        str,
        typer.Option(help="Shape of the road: straight, loop, figure8, random, or a file of KITTI poses to follow."),
    ] = "loop",
    preset: Annotated[
        PresetName, typer.Option(help="World: city, suburb, rural, highway, tunnel, indoor or car_park.")
    ] = "city",
    images: Annotated[bool, typer.Option("--images/--no-images", help="Write images of the camera (image_2).")] = True,
    traffic: Annotated[
        float,
        typer.Option(
            help="Amount of traffic, relative to the preset's. Above 1 cars drive in columns on every lane; 20 fills "
            "all lanes."
        ),
    ] = 1.0,
    sensor: Annotated[
        Literal["clean", "real"],
        typer.Option(help="Errors of the LiDAR; clean: only noise; real: those of KITTI's LiDAR."),
    ] = "clean",
    pattern: Annotated[
        Literal["spinning", "rosette"],
        typer.Option(help="Scan pattern; rosette: 70 deg wide, to the front, different in every scan (Livox)."),
    ] = "spinning",
    beams: Annotated[int, typer.Option(help="Beams of the LiDAR: 16, 32, 64 or 128.")] = 64,
    height: Annotated[float, typer.Option(help="Height of the LiDAR above the ground, m.")] = 1.73,
    reach: Annotated[float, typer.Option("--range", help="Range of the LiDAR, m.")] = 80.0,
    imu: Annotated[
        bool, typer.Option("--imu", help="Also write imu.txt, of an IMU at 100 Hz with realistic errors.")
    ] = False,
    gnss: Annotated[
        bool, typer.Option("--gnss", help="Also write gnss.txt, fixes at 5 Hz of a receiver without corrections.")
    ] = False,
    workers: Workers = PROCESSORS,
) -> None:
    """Simulate a drive: scans, images, poses, point labels, scans without moving objects, and a map of the ground."""
    from dpm2_core.sim.drive import simulate  # embree and the rest are slow to import for the other commands

    lidar = {"pattern": pattern, "beams": beams, "height": height, "range": reach}
    tree: dict[str, Any] = {"frames": frames, "seed": seed, "road": road, "preset": preset, "images": images}
    tree |= {"traffic": traffic, "lidar": lidar, "imu": {} if imu else None, "gnss": {} if gnss else None}
    drive = settings_from(DriveConfig, tree, default="dpm2 sim")
    if sensor == "real":
        drive = drive.model_copy(update={"lidar": real_sensor(drive.lidar)})
    with counted(f"{preset} -> {out}") as progress:
        made = simulate(out, drive, workers, progress)
    note(f"{out}: {'written' if made else 'contains this drive already, nothing was written'}")
