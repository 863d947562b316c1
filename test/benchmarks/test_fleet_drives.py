# SPDX-License-Identifier: Apache-2.0
"""The fleet's benchmark: its parts are known, and an unknown one is an error of use."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.fleet import bench_fleet
from benchmarks.harness import Options
from dpm2_core.errors import UsageError


def test_a_part_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--only speed: no such part; choose from town, index, .*, whole"):
        bench_fleet(Options(only="speed", out=tmp_path))
    assert not list(tmp_path.iterdir())
