# SPDX-License-Identifier: Apache-2.0
"""The evaluation of a second camera on a few scans: true poses are the scans', and each method uses its images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks import second_camera
from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Registration
from dpm2_core.frame import Frame
from dpm2_core.geometry import se3
from dpm2_core.network.model import DeepPointMap2


@pytest.mark.slow
def test_each_pair_is_registered_with_the_images_of_each_way(
    model: DeepPointMap2, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network that always predicts 1.25 m ahead is right for neighbors in a straight tunnel, and 1.25 m off
    beyond."""
    seen: list[tuple[str, ...]] = []
    describe = model.describe

    def noted(frame: Frame) -> Descriptors:
        seen.append(tuple(image.camera.name for image in frame.images))
        return describe(frame)

    def one_step(*_: Any) -> Registration:
        return Registration(se3.exp([0, 0, 0, second_camera.STEP, 0, 0]), np.eye(6))

    monkeypatch.setattr(second_camera, "FRAMES", 3)
    monkeypatch.setattr(second_camera, "APART", (1, 2))
    monkeypatch.setattr(model, "describe", noted)
    monkeypatch.setattr(model, "register", one_step)
    errors = second_camera.errors(model, "tunnel", 930_100)
    assert seen == list(second_camera.WAYS) * 3
    assert errors.shape == (len(second_camera.WAYS), 3, 2)
    np.testing.assert_allclose(errors[..., 0], np.tile([0, 0, second_camera.STEP], (5, 1)), atol=0.1)
    assert errors[..., 1].max() < 2
