# SPDX-License-Identifier: Apache-2.0
"""Names of maps in their folder."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from dpm2_ros.map_folder import MapFolder


def test_a_number_is_at_the_end_of_a_name_with_a_dot(tmp_path: Path) -> None:
    maps = MapFolder(tmp_path, "")
    assert [maps.claimed("site.1", None).name for _ in range(3)] == ["site.1", "site.1-2", "site.1-3"]
    requested = tmp_path / "site.2.dpm2map"
    assert [path.name for path in islice(maps.free(requested), 2)] == ["site.2.dpm2map", "site.2-2.dpm2map"]
