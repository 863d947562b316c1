# SPDX-License-Identifier: Apache-2.0
"""The attention that is shown is the one that the network used."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from dpm2_core.errors import UsageError
from dpm2_core.evaluation.image_attention import image_attention
from dpm2_core.frame import Frame
from dpm2_core.network.model import DeepPointMap2

from ...helpers.networks import tiny
from ...helpers.scenes import boxes, make_image


@pytest.fixture
def frame() -> Frame:
    noise = np.random.default_rng(0)
    points = np.c_[boxes(noise), np.full(4000, 0.5)].astype(np.float32)
    return Frame(0, points, images=(make_image(noise),))


def test_a_point_attends_around_where_it_is_seen(model: DeepPointMap2, frame: Frame) -> None:
    """Even untrained, due to the distance from rays: the attention is highest near the point's projection."""
    looked = image_attention(model, frame)
    height, width = model.settings.image.size
    assert looked.heat.shape == looked.pixels.shape[:2] == (height, width)
    assert looked.heat.max() == pytest.approx(1)
    assert looked.heat.min() >= 0
    distances = []
    for point in np.flatnonzero(looked.seen):
        other = image_attention(model, frame, int(point))
        v, u = np.unravel_index(other.heat.argmax(), other.heat.shape)
        distances.append(np.hypot(u - other.uv[point, 0], v - other.uv[point, 1]))
    assert np.median(distances) < 12  # pixels; the maps have strides of 8 and 16, chance would give about 25


def test_it_leaves_the_network_as_it_was(model: DeepPointMap2, frame: Frame) -> None:
    """No hook remains, and descriptors are the same as before."""
    before = model.describe(frame).features
    image_attention(model, frame)
    pickle.dumps(model)  # this would fail with the hook, an anonymous function
    assert np.array_equal(model.describe(frame).features, before)


def test_what_cannot_be_shown_is_said(model: DeepPointMap2, frame: Frame) -> None:
    """Without an image, without the point in it, or without a camera, an error gives the reason."""
    with pytest.raises(UsageError, match="has no image"):
        image_attention(model, Frame(0, frame.points))
    behind = int(np.flatnonzero(~image_attention(model, frame).seen)[0])
    with pytest.raises(UsageError, match=f"point {behind}: want one in the image"):
        image_attention(model, frame, behind)
    with pytest.raises(UsageError, match="no image attention"):
        image_attention(DeepPointMap2(tiny(image={"backbone": "none"})), frame)
