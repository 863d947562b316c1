# SPDX-License-Identifier: Apache-2.0
"""Trajectories as other programs write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpm2_core.frame import Array


def write_indexed(path: Path, poses: Array, numbers: Sequence[int]) -> None:
    """Write poses (N, 4, 4) in KITTI's format, each after the number of its frame."""
    rows = np.column_stack([numbers, poses[:, :3].reshape(-1, 12)])
    np.savetxt(path, rows, ["%d"] + ["%.12e"] * 12)
