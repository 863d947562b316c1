# SPDX-License-Identifier: Apache-2.0
"""What a run notes of its frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.estimates import OdometryResult, Registration, State
from dpm2_core.evaluation.run_result import Result
from dpm2_core.slam.build import make_mapper
from dpm2_core.slam.settings import Config, SlamSettings


def test_frames_with_a_bad_image_or_bad_times_are_counted(recording: Path) -> None:
    """In timing.json; nothing is there where nothing was wrong."""
    source = open_source(recording, InputSettings(images=False))
    result = Result(source, Config(), make_mapper(SlamSettings()), None, "")
    found = Registration(np.eye(4), np.eye(6))
    good = OdometryResult(0, 0, np.eye(4), np.eye(6), np.zeros(6), State.TRACKING, found)
    result.add(good)
    assert "problems" not in result.timing
    result.add(replace(good, camera="the same image"))
    result.add(replace(good, camera="the same image", times="wrong times"))
    assert result.timing["problems"] == {"the same image": 2, "wrong times": 1}
