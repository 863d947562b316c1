# SPDX-License-Identifier: Apache-2.0
"""`dpm2 convert`: other recordings to rosbag2."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import progress_bar
from dpm2_core.console import Console

app = typer.Typer(no_args_is_help=True, help="Convert a recording to a rosbag2 (MCAP) folder.")


@app.callback()
def _group() -> None:
    """Keeps `kitti` a subcommand while it is the only one."""


@app.command()
def kitti(
    src: Annotated[Path, typer.Argument(help="KITTI odometry sequence folder, or the root above sequences/.")],
    out: Annotated[Path, typer.Argument(help="rosbag2 folder to make.")],
    sequence: Annotated[str, typer.Option(help="Sequence of the root, such as 04.")] = "",
    start: Annotated[int, typer.Option(min=0, help="First scan, counted from 0.")] = 0,
    end: Annotated[int | None, typer.Option(min=0, help="Scan to stop before.")] = None,
    images: Annotated[bool, typer.Option("--images/--no-images", help="With image_2.")] = True,
    zstd: Annotated[bool, typer.Option("--zstd", help="Compress: about a third smaller, and slower.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a bag that is there.")] = False,
) -> None:
    """KITTI odometry to a bag with the topic names of kitti2bag, ground truth included where there is some."""
    from dpm2_core.data.convert import convert_kitti  # rosbags is slow to import for the other commands
    from dpm2_core.data.kitti import KittiSource
    from dpm2_core.data.settings import InputSettings

    console = Console(stderr=True)
    with progress_bar(console) as bar:
        task = bar.add_task(f"{src} -> {out}", total=None)
        source = KittiSource(src, InputSettings(sequence=sequence, images=images))
        notes = convert_kitti(
            source, out, (start, end), zstd, overwrite,
            lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    for note in notes:
        console.print(f"note: {note}", highlight=False)
