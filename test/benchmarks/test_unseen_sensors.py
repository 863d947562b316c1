# SPDX-License-Identifier: Apache-2.0
"""Worlds seen by other LiDARs: all see the same places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.unseen_sensors import SENSORS, drive
from dpm2_core.data.packed import open_packed
from dpm2_core.network.settings import preset


@pytest.mark.long
def test_every_sensor_sees_the_same_places(tmp_path: Path) -> None:
    for name in ("16 beams", "rosette"):
        drive(tmp_path / name, "suburb", 5, SENSORS[name], preset("small"), scans=2)
    rosette, beams = sorted(open_packed(tmp_path), key=lambda packed: packed[0].cloud[:, 0].min())[::-1]
    np.testing.assert_allclose(rosette.poses, beams.poses)
    assert (rosette[0].cloud[:, 0] > 0).all()  # only ahead
    assert beams[0].cloud[:, 0].min() < -5
