# SPDX-License-Identifier: Apache-2.0
"""A keyframe's payload passes through its messages unchanged; inconsistent messages are rejected, and named."""

from __future__ import annotations

from array import array
from dataclasses import replace

import numpy as np
import pytest
from sensor_msgs.msg import PointField

from dpm2_core.data.thumbnail import image_of, thumbnail
from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Fix
from dpm2_core.slam.mapping.admission import RejectedError
from dpm2_core.slam.store.cloud_codec import origin_of, unpack_cloud
from dpm2_ros.keyframe_messages import (
    BUDGET,
    descriptors_from_msg,
    descriptors_to_msg,
    payload_from_msg,
    payload_to_msgs,
)

from ..helpers.scenes import make_image

FIX = Fix(7, np.array([49.0, 8.4, 116.0]), np.diag([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]))


def keyframe(noise: np.random.Generator, fix: Fix | None, picture: bytes | None, points: int = 500) -> Keyframe:
    cloud = noise.uniform(-20, 20, (points, 4)).astype(np.float32)
    return Keyframe(3, 5, 3, np.eye(4), cloud, None, "", None, picture, fix)


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize("pictured", [True, False])
def test_fix_thumbnail_and_origin_travel_with_the_cloud(
    noise: np.random.Generator, fixed: bool, pictured: bool
) -> None:
    """All of them are sent within the budget, in any combination: only the cloud is reduced."""
    picture = thumbnail(make_image(noise), 200) if pictured else None
    sent = replace(keyframe(noise, FIX if fixed else None, picture, 100_000), origin=np.array([1.0, 0, 1.75]))
    payload = payload_from_msg(payload_to_msgs(sent, "a/3")[1])
    assert payload.thumbnail == picture
    assert (payload.fix is None) == (not fixed)
    if payload.fix is not None:
        assert payload.fix.stamp == 7
        for name in ("geodetic", "covariance", "antenna"):
            np.testing.assert_array_equal(getattr(payload.fix, name), getattr(FIX, name))
    assert 1000 < len(unpack_cloud(payload.cloud)) < 100_000
    assert origin_of(payload.cloud).tolist() == [1, 0, 1.75]
    assert len(payload.cloud) + len(picture or b"") < BUDGET


@pytest.mark.parametrize(("size", "width"), [((1024, 768), 1024), ((720, 720), 320)], ids=["wide", "square"])
def test_a_picture_that_would_cost_the_cloud_its_points_comes_smaller(
    noise: np.random.Generator, size: tuple[int, int], width: int
) -> None:
    """A thumbnail of the largest width of `slam.map.thumbnail`, or a square one of the width for place recognition, is
    sent smaller, so that it does not displace the cloud's points."""
    picture = thumbnail(make_image(noise, size), width)
    assert len(picture) > 20_000
    payload = payload_from_msg(payload_to_msgs(keyframe(noise, FIX, picture), "a/3")[1])
    assert payload.fix is not None
    assert payload.thumbnail is not None
    assert 14_000 < len(payload.thumbnail) <= 20_000  # it is reduced no more than necessary
    whole, small = image_of(picture), image_of(payload.thumbnail)
    assert small.camera.size[0] / small.camera.size[1] == pytest.approx(size[0] / size[1], rel=0.01)  # whole pixels
    np.testing.assert_array_equal(small.camera.K, whole.camera.resized(*small.camera.size).K)
    np.testing.assert_array_equal(small.camera.T_lidar_cam, whole.camera.T_lidar_cam)


def test_a_large_picture_without_a_camera_stays_at_home(noise: np.random.Generator) -> None:
    """A large image without a camera is left out: it could not be used, and no node makes one."""
    picture = thumbnail(make_image(noise, (1024, 768)), 1024)
    payload = payload_from_msg(payload_to_msgs(keyframe(noise, FIX, picture.replace(b'"size"', b'"seize"')), "a/3")[1])
    assert payload.thumbnail is None
    assert payload.fix is not None


def test_descriptors_travel_in_half_of_the_budget(noise: np.random.Generator) -> None:
    """All 320 of a frame fit; of more, only the first ones: any number of first ones is as evenly spread as all."""
    for count, most in ((600, 325), (320, 320)):
        made = Descriptors.of(noise.normal(0, 15, (count, 3)).astype("f4"), noise.normal(0, 1, (count, 128)))
        sent = replace(keyframe(noise, FIX, None, 100_000), descriptors=made)
        message, payload = payload_to_msgs(sent, "a/3", "0123456789abcdef")
        got, weights = descriptors_from_msg(message)
        assert weights == "0123456789abcdef"
        assert got is not None
        np.testing.assert_array_equal(got.xyz, made.xyz[:most])
        np.testing.assert_array_equal(got.axes, made.axes[:most])
        np.testing.assert_array_equal(got.values, made.values[:most])
        assert len(message.data) + len(payload.data) <= BUDGET


def test_descriptors_of_another_type_are_rejected(noise: np.random.Generator) -> None:
    made = Descriptors.of(noise.normal(0, 15, (9, 3)).astype("f4"), noise.normal(0, 1, (9, 8)))
    message = descriptors_to_msg(made, 5, "a/3", "0123456789abcdef")
    for kind in (PointField.UINT16, PointField.FLOAT64):
        message.fields[-1].datatype = kind
        with pytest.raises(RejectedError, match="0 channels of int8"):
            descriptors_from_msg(message)


def test_parts_that_do_not_add_up_are_rejected(noise: np.random.Generator) -> None:
    picture = thumbnail(make_image(noise), 32)
    message = payload_to_msgs(keyframe(noise, FIX, picture), "a/3")[1]
    message.layout.dim[1].size = 2**32 - 1
    with pytest.raises(RejectedError, match="bytes for parts of"):
        payload_from_msg(message)
    message = payload_to_msgs(keyframe(noise, FIX, picture), "a/3")[1]
    message.layout.dim[0].size += 8
    message.layout.dim[1].size -= 8
    with pytest.raises(RejectedError, match="a fix of 120 bytes"):
        payload_from_msg(message)
    message = payload_to_msgs(keyframe(noise, None, picture), "a/3")[1]
    message.data = array("B", bytes(message.data).replace(b'"size": [32', b'"size": [99'))
    with pytest.raises(RejectedError, match="the camera has 99 x"):
        payload_from_msg(message)
