# SPDX-License-Identifier: Apache-2.0
"""The live view of a run, and the map's page in a real browser, for a drive of a few frames."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.harness import Options
from benchmarks.views import bench_views
from tools.browser import chromium


@pytest.mark.slow
def test_both_are_measured(recording: Path) -> None:
    """Every figure of the table is from a real event: a recording, a page that was drawn and rotated."""
    pytest.importorskip("rerun")
    pytest.importorskip("playwright")
    if chromium() is None:
        pytest.skip("no Chromium")
    (row,) = bench_views(Options(sources=[recording])).results["drives"].values()
    assert row["frames"] > 0
    assert 0 < row["view_cost"] < 1
    assert row["recording_megabytes"] > 0
    page = row["page"]
    assert page["keyframes"] >= 1
    assert 0 < page["seconds_to_first"] <= page["seconds_to_all"]
    assert page["frames_per_second"] > 0
