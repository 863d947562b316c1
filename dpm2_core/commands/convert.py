# SPDX-License-Identifier: Apache-2.0
"""`dpm2 convert`: other recordings to rosbag2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import ConfigFile, Overrides
from dpm2_core.config import load_settings
from dpm2_core.console import Console, progress_bar
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import Source, Span, parse_range
from dpm2_core.slam.settings import Config

app = typer.Typer(no_args_is_help=True, help="Convert a recording to a rosbag2 (MCAP) folder.")

Out = Annotated[Path, typer.Argument(help="rosbag2 folder to make.")]
Zstd = Annotated[bool, typer.Option("--zstd", help="Compress: about a third smaller, and slower.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a bag that is there.")]


@app.command()
def kitti(
    src: Annotated[Path, typer.Argument(help="KITTI odometry sequence folder, or the root above sequences/.")],
    out: Out,
    sequence: Annotated[str, typer.Option(help="Sequence of the root, such as 04.")] = "",
    start: Annotated[int, typer.Option(min=0, help="First scan, counted from 0.")] = 0,
    end: Annotated[int | None, typer.Option(min=0, help="Scan to stop before.")] = None,
    images: Annotated[bool, typer.Option("--images/--no-images", help="With image_2.")] = True,
    zstd: Zstd = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI odometry to a bag with the topic names of kitti2bag, ground truth included where there is some."""
    from dpm2_core.data.kitti import KittiSource

    settings = InputSettings(sequence=sequence, images=images)
    _convert(lambda: KittiSource(src, settings), src, out, (start, end), zstd, overwrite)


@app.command()
def drive(
    src: Annotated[Path, typer.Argument(help="Any recording that `dpm2 run` reads.")],
    out: Out,
    frames: Annotated[str, typer.Option(help="Which frames, a:b by position from 0.")] = ":",
    config: ConfigFile = None,
    settings: Overrides = None,
    zstd: Zstd = False,
    overwrite: Overwrite = False,
) -> None:
    """Any recording (KITTI-360, MulRan, Ouster, PCD, ROS 1, ...) to a bag with /points, /camera/image_raw, /imu, ..."""
    chosen = load_settings(Config, config, settings or []).input
    _convert(lambda: open_source(src, chosen), src, out, parse_range(frames), zstd, overwrite)


def _convert(opened: Callable[[], Source], src: Path, out: Path, frames: Span, zstd: bool, overwrite: bool) -> None:
    from dpm2_core.data.convert import convert  # rosbags is slow to import for the other commands

    console = Console(stderr=True)
    with progress_bar(console) as bar:
        task = bar.add_task(f"{src} -> {out}", total=None)
        notes = convert(
            opened(), out, frames, zstd, overwrite,
            lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    for note in notes:
        console.print(f"note: {note}", highlight=False)
