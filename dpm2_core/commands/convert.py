# SPDX-License-Identifier: Apache-2.0
"""`dpm2 convert`: any recording to rosbag2."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import ConfigFile, InputOverrides, note
from dpm2_core.config import load_settings
from dpm2_core.console import counted


def convert(
    src: Annotated[Path, typer.Argument(help="Any recording that `dpm2 run` reads.")],
    out: Annotated[Path, typer.Argument(help="rosbag2 folder to write.")],
    frames: Annotated[str, typer.Option(help="Frames a to b - 1, as a:b, counted from 0; `:` is all.")] = ":",
    config: ConfigFile = None,
    settings: InputOverrides = None,
    zstd: Annotated[bool, typer.Option("--zstd", help="Compress the bag: a third smaller, but slower.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing bag.")] = False,
) -> None:
    """Convert a recording to a rosbag2 (MCAP) folder.

    KITTI odometry is written with the topics of kitti2bag, other recordings with /points, /camera/image_raw, /imu, ...
    Ground truth is included if available.
    """
    from dpm2_core.data.convert import convert as write_bag  # rosbags is slow to import for the other commands
    from dpm2_core.data.open import open_source
    from dpm2_core.data.settings import input_settings
    from dpm2_core.data.source import parse_range
    from dpm2_core.slam.settings import Config

    input_settings(settings or [])  # settings of the SLAM have no effect here: reject them
    chosen, span = load_settings(Config, config, settings or []).input, parse_range(frames)
    with counted(f"{src} -> {out}") as progress:
        notes = write_bag(open_source(src, chosen), out, span, zstd, overwrite, progress)
    for text in notes:
        note(f"note: {text}")
