# SPDX-License-Identifier: Apache-2.0
"""A room is described and registered as if it had the size of a street."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpm2_core.frame import R_AHEAD, Camera, Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ROOM_SCALE, is_room
from dpm2_core.network.images import in_encoded_axes
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pretrained import load_network
from test.helpers.rooms import frames

FIRST = se3.make(np.eye(3), [-0.5, 0.2, 0.6])
SECOND = FIRST @ se3.exp([0, 0, 0.4, 0.8, 0.1, 0])


@pytest.fixture(scope="module")
def network() -> DeepPointMap2:
    return load_network("small", 1)


def enlarged(frame: Frame) -> Frame:
    points = frame.points.copy()
    points[:, :3] *= ROOM_SCALE
    return Frame(frame.stamp, points)


@pytest.mark.weights
def test_a_room_is_registered_to_centimeters(network: DeepPointMap2) -> None:
    target, source = (network.describe(frame) for frame in frames(np.stack([FIRST, SECOND])))
    assert target.scale == source.scale == ROOM_SCALE
    assert np.abs(target.xyz).max() < 4  # m: in the size of the room
    found = network.register(source, target)
    meters, degrees = se3.magnitude(found.T_target_source @ se3.inverse(SECOND) @ FIRST)
    assert found.ok
    assert meters < 0.05
    assert degrees < 1.0


@pytest.mark.weights
def test_what_is_said_of_a_room_is_what_is_said_of_the_street_that_it_resembles(network: DeepPointMap2) -> None:
    """Rotations are equal; lengths and their uncertainty are a fifth."""
    room = frames(np.stack([FIRST, SECOND]))
    street = [enlarged(frame) for frame in room]
    assert not any(is_room(frame.points) for frame in street)
    (a, b), (c, d) = ([network.describe(frame) for frame in pair] for pair in (room, street))
    np.testing.assert_array_equal(a.features, c.features)
    np.testing.assert_allclose(a.xyz * ROOM_SCALE, c.xyz, atol=1e-4)
    small, large = network.register(b, a), network.register(d, c)
    T = large.T_target_source.copy()
    T[:3, 3] /= ROOM_SCALE
    np.testing.assert_allclose(small.T_target_source, T, atol=1e-3)  # the network works in bf16
    S = np.repeat([1.0, 1 / ROOM_SCALE], 3)
    np.testing.assert_allclose(small.covariance, large.covariance * np.outer(S, S), rtol=0.1, atol=1e-7)
    assert small.floor == pytest.approx((large.floor[0], large.floor[1] / ROOM_SCALE), rel=0.01)
    assert (np.linalg.eigvalsh(small.of_scene) > 0).all()
    assert small.rmse == pytest.approx(large.rmse / ROOM_SCALE, rel=0.05)
    many = network.register_many([b, d], [a, c])
    np.testing.assert_allclose(many[0].T_target_source, small.T_target_source, atol=1e-3)
    at_source, at_target, _ = network.matches(b, a)
    assert max(np.abs(at_source).max(), np.abs(at_target).max()) < 4


@pytest.mark.weights
def test_a_room_and_a_street_are_not_registered(network: DeepPointMap2) -> None:
    room = network.describe(frames(FIRST[None])[0])
    street = network.describe(frames(FIRST[None], street=True)[0])
    assert street.scale == 1
    for source, target in ((room, street), (street, room)):
        result = network.register(source, target)
        assert not result.ok
        assert "one scan is of a room, the other is not" in result.reason
    assert network.agreement(room, [street]) == [0.0]


def test_a_camera_in_an_enlarged_scene_stands_farther_from_the_lidar_and_sees_the_same() -> None:
    K = np.array([[300.0, 0, 160], [0, 300, 60], [0, 0, 1]])
    image = Image(np.zeros((120, 320, 3), np.uint8), Camera(K, se3.make(R_AHEAD, [0.1, -0.2, 0.3]), (320, 120)))
    point = np.array([3.0, 0.4, -0.2])

    def pixel(camera: Camera, at: np.ndarray) -> np.ndarray:
        seen = camera.K @ se3.transform(se3.inverse(camera.T_lidar_cam), at[None])[0]
        return seen[:2] / seen[2]

    other = in_encoded_axes(image, np.eye(3, dtype=np.float32), 5.0)
    np.testing.assert_allclose(pixel(other.camera, 5 * point), pixel(image.camera, point), atol=1e-4)
    assert replace(other, camera=image.camera).pixels is image.pixels
