# SPDX-License-Identifier: Apache-2.0
"""The pyramid of a scan with images: image corners among its reference points, each with its texture."""

from __future__ import annotations

import numpy as np
import torch

from dpm2_core.geometry.corners import TEXTURE
from dpm2_core.network.encoder import Encoder
from dpm2_core.network.pyramid import build_pyramid, collate
from dpm2_core.network.settings import NetworkSettings

from ...helpers.networks import tiny
from ...helpers.painted import SIZE, image, paint, scan

PAINT = paint(0)


def network(corners: float) -> NetworkSettings:
    return tiny(image={"size": list(SIZE)}, fusion={"corners": corners})


def test_corners_are_spread_among_the_reference_points() -> None:
    """They are half of them here, in every prefix, each with a texture of unit length; the others have none."""
    settings = network(0.5)
    pyramid = build_pyramid(scan(2.0, 0), settings, [image(PAINT, 2.0)])
    length = np.linalg.norm(pyramid.texture.astype(float), axis=1)
    is_corner = length > 0
    assert pyramid.texture.shape == (settings.fusion.points, TEXTURE)
    assert is_corner.sum() == settings.fusion.points // 2
    assert np.allclose(length[is_corner], 1, atol=2e-3)  # float16
    assert np.abs(is_corner.cumsum() - np.arange(1, len(is_corner) + 1) / 2).max() <= 1


def test_they_are_where_two_scans_see_the_same() -> None:
    """1 m farther along a wall without structure, corners are found again; the other reference points are not."""
    here, there = (build_pyramid(scan(x, round(x)), network(0.5), [image(PAINT, x)]) for x in (2.0, 3.0))
    n = len(here.texture)
    apart = np.linalg.norm((here.xyz[:n] - np.float32([1, 0, 0]))[:, None] - there.xyz[None, :n], axis=-1).min(1)
    is_corner = here.texture.any(1)
    assert (apart[is_corner] < 0.2).mean() > 2 * (apart[~is_corner] < 0.2).mean()


def test_without_an_image_or_the_setting_or_a_camera_there_are_none() -> None:
    cloud = scan(2.0, 0)
    plain = build_pyramid(cloud, network(0.0))
    blind = tiny(image={"backbone": "none"}, fusion={"corners": 0.5})
    for settings, images in ((network(0.5), []), (network(0.0), [image(PAINT, 2.0)]), (blind, [image(PAINT, 2.0)])):
        other = build_pyramid(cloud, settings, images)
        assert np.array_equal(other.xyz, plain.xyz)
        assert not other.texture.any()


def test_two_cameras_share_them() -> None:
    """Each gives half of the corners; the order of the cameras does not change the number."""
    both = [image(PAINT, 2.0), image(paint(1), 2.0)]
    texture = build_pyramid(scan(2.0, 0), network(0.5), both).texture
    assert texture.any(1).sum() == network(0.5).fusion.points // 2


def test_a_scan_of_fewer_points_than_references() -> None:
    """At most half of its points are corners."""
    cloud = scan(2.0, 0)
    nearest = cloud[np.argsort(np.linalg.norm(cloud - np.float32([8, 6, 0]), axis=1))[:40]]
    pyramid = build_pyramid(nearest, network(0.5), [image(PAINT, 2.0)])
    assert pyramid.count == 40
    assert pyramid.texture.any(1).sum() <= 20
    assert not pyramid.texture[40:].any()


def test_the_texture_is_in_the_descriptor() -> None:
    """Only a corner has one: with the same points, another texture changes only that corner's row."""
    torch.manual_seed(0)
    settings = network(0.5)
    encoder = Encoder(settings).eval()
    points = collate([build_pyramid(scan(2.0, 0), settings, [image(PAINT, 2.0)])])
    corner = int(points.texture[0].any(1).nonzero()[0])
    other = points.texture.clone()
    other[0, corner] = -other[0, corner]
    with torch.inference_mode():
        one, two = (encoder(p).tokens.features[0] for p in (points, points._replace(texture=other)))
    changed = (one != two).any(1)
    assert changed.nonzero().flatten().tolist() == [corner]


def test_its_weights_learn() -> None:
    settings = network(0.5)
    encoder = Encoder(settings)
    points = collate([build_pyramid(scan(2.0, 0), settings, [image(PAINT, 2.0)])])
    encoder(points).tokens.features.square().sum().backward()
    assert encoder.fusion is not None
    gradient = encoder.get_parameter("fusion.texture.weight").grad
    assert gradient is not None
    assert gradient.abs().max() > 0
