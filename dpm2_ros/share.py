# SPDX-License-Identifier: Apache-2.0
"""The folder of the installed files: DDS profile, RViz layout, launch file."""

from __future__ import annotations

import sys
from pathlib import Path

from dpm2_core.errors import Dpm2Error


def share_directory() -> Path:
    """Folder with config/ and launch/: the source tree of an editable or symlinked install, else share/dpm2_ros.

    Raises:
        Dpm2Error: neither exists.
    """
    candidates = [Path(__file__).resolve().parents[1]]
    # colcon: PREFIX/lib/pythonX.Y/site-packages/dpm2_ros/share.py, and so with pip; --user and --target differ.
    candidates += [parent / "share" / "dpm2_ros" for parent in (*Path(__file__).parents, Path(sys.prefix))]
    for folder in candidates:
        if (folder / "config" / "fastdds.xml").is_file():
            return folder
    raise Dpm2Error(
        f"config/fastdds.xml is neither in the source tree nor in {Path(sys.prefix) / 'share' / 'dpm2_ros'}"
    )
