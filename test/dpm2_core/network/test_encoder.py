# SPDX-License-Identifier: Apache-2.0
"""Encoder: sizes, masks, invariances, and missing images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.network.convnext import FeatureMap
from dpm2_core.network.encoder import Encoder
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pointnext import argmax_neighbor
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.pyramid import build_pyramid, collate, crop
from dpm2_core.network.settings import PRESETS, preset
from dpm2_core.network.spatial import image_features, paint, seen_from
from dpm2_core.network.views import Views, collate_views
from dpm2_core.network.weights import network_settings

from ...helpers.networks import tiny
from ...helpers.scenes import boxes, make_image


def frame(cloud: np.ndarray, *images: Image) -> Frame:
    """A frame of (N, 3) points."""
    return Frame(0, np.column_stack([cloud, np.zeros(len(cloud))]).astype(np.float32), images=images)


def parameters(module: torch.nn.Module) -> int:
    """Number of parameters."""
    return sum(p.numel() for p in module.parameters())


def test_parameters_are_those_of_deep_point_map() -> None:
    """Version 1, LiDAR only: 3.824 M in the encoder, 2.776 M in the decoder, as counted from the published shapes."""
    model = DeepPointMap2(preset("v1"))
    assert round(parameters(model.encoder) / 1e6, 3) == 3.824
    assert round(parameters(model.decoder) / 1e6, 3) == 2.776


@pytest.mark.parametrize("name", PRESETS)
def test_presets_give_descriptors_of_128_channels(name: str, noise: np.random.Generator) -> None:
    """320 in `small`, 256 in the others: 86 or 69 kB per frame."""
    torch.manual_seed(0)
    out = Encoder(preset(name)).eval().encode(frame(boxes(noise, 6000)))
    count = 320 if name == "small" else 256
    assert out.xyz.shape == (count, 3)
    assert out.features.shape == (count, 128)
    assert out.xyz.nbytes + out.features.nbytes <= 268 * count
    assert np.isfinite(out.features).all()


@pytest.mark.weights
def test_the_shipped_weights_are_of_the_preset_small() -> None:
    """With all its settings, so that a training that starts from them needs no change to the preset."""
    assert network_settings(weights_path("small")) == preset("small")


def test_unknown_preset_and_backbone_are_rejected() -> None:
    """The error is one line that names the choices."""
    with pytest.raises(UsageError, match=r"network preset big: want one of small, base, paper, v1"):
        preset("big")
    with pytest.raises(UsageError, match=r"points.backbone: input should be 'pointnext', got 'kpconv'"):
        tiny(points={"backbone": "kpconv"})
    with pytest.raises(UsageError, match=r"image.backbone vgg: want one of none, convnext, timm:NAME"):
        Encoder(tiny(image={"backbone": "vgg"}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"decoder": {"width": 33}}, r"decoder.width 33 is no multiple of decoder.heads 4"),
        ({"channels": 30}, r"channels 30 is no multiple of fusion.heads 4"),
        ({"channels": 64, "fusion": {"kind": "none"}}, r"channels 64: without fusion .* points.stages.\d, which"),
        ({"image": {"depths": [1, 1]}}, r"image.depths has 2 stages, image.channels 4"),
        ({"image": {"strides": [8, 12]}}, r"image.strides \[8, 12\]: want some of 4, 8, 16, 32"),
        ({"fusion": {"levels": [1, 4]}}, r"fusion.levels \[1, 4\]: want some of 0 to 3"),
        ({"fusion": {"points": 4096}}, r"fusion.points 4096: the first of points.stages has 2048"),
        ({"fusion": {"alpha_image": [0.3, 1.0]}}, r"fusion.alpha_image has 2 values"),
        ({"points": {"upsample": 4}}, r"points.upsample 4 of 4 stages"),
        ({"points": {"stages": []}}, r"points.stages: .*at least 1 item"),
    ],
)
def test_settings_that_do_not_fit_each_other_are_named(changes: dict[str, Any], message: str) -> None:
    """The error names the settings. Previously, they ended in tracebacks, some of them at the first step of a
    training."""
    with pytest.raises(UsageError, match=f"preset small.*{message}"):
        preset("small", changes)


def test_order_of_points_changes_nothing(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """A scan with one point per voxel gives the same descriptors for any order of its points."""
    cloud = crop(boxes(noise, 1500), model.settings.points)
    one, other = (model.describe(frame(c)) for c in (cloud, noise.permutation(cloud)))
    assert np.array_equal(one.xyz, other.xyz)
    assert np.array_equal(one.features, other.features)


def test_heading_changes_nothing(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """If the scan is rotated about the vertical, the same samples get the same features, as `view_aligned` requires."""
    pyramid = build_pyramid(boxes(noise, 1500), model.settings)
    R = se3.exp([0, 0, 2.1, 0, 0, 0])[:3, :3].astype(np.float32)
    turned = replace(pyramid, xyz=pyramid.xyz @ R.T, patches=(pyramid.patches @ R.T).astype(np.float16))
    one, other = (model.encoder(collate([p])).tokens for p in (pyramid, turned))
    torch.testing.assert_close(one.features, other.features, atol=2e-3, rtol=0)  # patches are float16


def test_padding_changes_nothing(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """A sparse scan has the same encoding alone and in a batch with a full one; its padding is masked."""
    settings = model.settings
    sparse, full = build_pyramid(boxes(noise, 100)[:40], settings), build_pyramid(boxes(noise), settings)
    alone = model.encoder(collate([sparse])).tokens
    together = model.encoder(collate([full, sparse])).tokens
    assert together.mask.sum(1).tolist() == [48, 40]
    torch.testing.assert_close(together.features[1], alone.features[0], atol=1e-5, rtol=0)
    poisoned = sparse.xyz.copy()
    poisoned[sparse.count :] = 1e3  # the values of padding are not read, either
    changed = replace(sparse, xyz=poisoned)
    torch.testing.assert_close(
        model.encoder(collate([changed])).tokens.features[0, :40], alone.features[0, :40], atol=1e-5, rtol=0
    )


def test_a_result_that_is_not_finite_is_an_error(noise: np.random.Generator) -> None:
    """A result with values that are not finite, as from damaged weights or a library that does not write parts of its
    results, is an error."""
    broken = DeepPointMap2(tiny()).eval()
    with torch.no_grad():
        next(broken.encoder.parameters()).fill_(torch.nan)
    with pytest.raises(Dpm2Error, match="not finite"):
        broken.describe(Frame(0, np.pad(boxes(noise), ((0, 0), (0, 1)))))


@pytest.mark.parametrize("beams", [16, 32])
def test_sparse_sensors(model: DeepPointMap2, noise: np.random.Generator, beams: int) -> None:
    """With few beams, the descriptors are finite."""
    azimuth = np.linspace(-np.pi, np.pi, 100)
    elevation = np.radians(np.linspace(-15, -3, beams))[:, None]
    reach = 1.7 / np.tan(-elevation)
    cloud = np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), -1.7 + 0 * reach * azimuth], -1).reshape(-1, 3)
    assert np.isfinite(model.describe(frame(cloud)).features).all()


@pytest.mark.parametrize("cloud", [np.zeros((0, 3)), np.full((50, 3), np.nan), np.zeros((500, 3)), np.ones((5, 3)) * 9])
def test_empty_scans_are_rejected(model: DeepPointMap2, cloud: np.ndarray) -> None:
    """If no points are in range, an error reports how many there were."""
    with pytest.raises(Dpm2Error, match=r"scan has \d+ points within"):
        model.describe(frame(cloud))


def views_of(model: DeepPointMap2, *frames: list[Image]) -> Views:
    """Batch of images."""
    views = collate_views(frames, model.settings.image)
    assert views is not None
    return views


def test_missing_image_equals_no_camera(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """Exactly: in a batch in which only the other frame has an image, the result equals that of the LiDAR alone."""
    pyramid = build_pyramid(boxes(noise), model.settings)
    alone = model.encoder(collate([pyramid])).tokens.features
    both = model.encoder(collate([pyramid, pyramid]), views_of(model, [], [make_image(noise)])).tokens.features
    assert torch.equal(both[0], alone[0])
    assert (both[1] - alone[0]).abs().max() > 1e-3  # the image is used


def test_only_reference_points_in_view_read_the_image(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """With one fusion layer, points behind the camera do not depend on the pixels."""
    pyramid = build_pyramid(boxes(noise), model.settings)
    points = collate([pyramid])
    one, other = (model.encoder(points, views_of(model, [make_image(noise)])).tokens for _ in range(2))
    behind = one.xyz[0, :, 0] < 0
    assert torch.equal(one.features[0][behind], other.features[0][behind])
    assert not torch.equal(one.features[0][~behind], other.features[0][~behind])


@pytest.mark.slow
def test_several_cameras(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """Their order does not matter."""
    pyramid = build_pyramid(boxes(noise), model.settings)
    a, b = make_image(noise), make_image(noise)
    one = model.encoder(collate([pyramid]), views_of(model, [a, b])).tokens.features
    other = model.encoder(collate([pyramid]), views_of(model, [b, a])).tokens.features
    torch.testing.assert_close(one, other, atol=1e-5, rtol=0)


def test_two_cameras_do_not_disturb_each_other(model: DeepPointMap2, noise: np.random.Generator) -> None:
    """With one fusion layer, points in one image are described as with that image alone, others as by LiDAR alone."""
    points = collate([build_pyramid(boxes(noise), model.settings)])
    ahead, other = make_image(noise), make_image(noise)
    turned = np.diag([-1.0, -1, 1, 1]) @ other.camera.T_lidar_cam
    back = replace(other, camera=replace(other.camera, T_lidar_cam=turned))
    views = views_of(model, [ahead, back])
    tokens = model.encoder(points, views).tokens
    seen = [seen_from(tokens.xyz, views, view)[0] for view in (0, 1)]
    assert not (seen[0] & seen[1]).any()
    alone = [model.encoder(points, views_of(model, [image])).tokens.features[0] for image in (ahead, back)]
    alone.append(model.encoder(points).tokens.features[0])
    for mask, features in zip((*seen, ~seen[0] & ~seen[1]), alone, strict=True):
        assert mask.sum() >= 3
        torch.testing.assert_close(tokens.features[0][mask], features[mask], atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "kind", ["biased", "point_painting", "roi_pooling", "scale_dot", "without_learnable", "without_spatial"]
)
@pytest.mark.parametrize("reference", ["fps", "uniform", "normal"])
def test_alternatives_of_the_ablations(noise: np.random.Generator, kind: str, reference: str) -> None:
    """Every choice of Tables 3 and 4 runs, uses the image, and gives each of its parameters a gradient."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny(fusion={"kind": kind, "reference": reference}))
    points = collate([build_pyramid(boxes(noise), model.settings)])
    features = model.encoder(points, views_of(model, [make_image(noise)])).tokens.features
    features.square().sum().backward()
    fusion = model.encoder.fusion
    assert fusion is not None
    without = {name for name, p in fusion.named_parameters() if p.grad is None}
    assert not without
    assert features.isfinite().all()


def test_a_painted_cloud_carries_the_color_of_its_pixel(noise: np.random.Generator) -> None:
    """Points ahead have the color of a red image, the others none. Before training it changes no feature, later it
    does. A missing image is treated as one in which no point is visible."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny(fusion={"kind": "point_painting"})).eval()
    cloud = boxes(noise)
    points = collate([build_pyramid(cloud, model.settings)])
    image = make_image(noise)
    red = replace(image, pixels=np.full_like(image.pixels, 0))
    red.pixels[..., 0] = 255
    views = views_of(model, [red])
    assert views is not None
    colors = paint(points.xyz, views)
    seen = seen_from(points.xyz, views, 0)
    assert 0 < int(seen.sum()) < seen.numel()
    assert (colors[seen][:, 0] > 0.99).all()
    assert (colors[seen][:, 3] == 1).all()
    assert not colors[..., 1:3].any()
    assert not colors[~seen].any()
    with torch.no_grad():
        plain = model.encoder(points).tokens.features
        torch.testing.assert_close(model.encoder(points, views).tokens.features, plain)
        weight = model.encoder.get_parameter("points.patch.paint.weight")
        weight.normal_(generator=torch.Generator().manual_seed(1))
        painted = model.encoder(points, views).tokens.features
        torch.testing.assert_close(model.encoder(points).tokens.features, plain)
    assert not torch.allclose(painted, plain, atol=1e-3)


def test_argmax_neighbor() -> None:
    """It equals the index that `amax` would choose, in bf16 and float32, including negative values."""
    torch.manual_seed(0)
    for dtype in (torch.bfloat16, torch.float32):
        sums = (torch.randn(2, 9, 24, 8) - 1).to(dtype)
        best = argmax_neighbor(sums)
        found = sums.gather(2, best[:, :, None])[:, :, 0]
        torch.testing.assert_close(found, sums.amax(2), atol=1e-4, rtol=1e-4)  # float32 loses 8 bits to the index


def test_argmax_neighbor_of_nan_is_in_range() -> None:
    """The maximum of NaN in vector registers has all bits set, those of an index beyond the neighbors. Previously, a
    training whose features became NaN ended in torch's traceback instead of the error that it diverged."""
    assert argmax_neighbor(torch.full((1, 2, 8, 64), torch.nan)).max() < 8


def test_the_feature_of_the_own_pixel_begins_as_nothing(noise: np.random.Generator) -> None:
    """At first the network equals one without it, and always where no view sees the point; several views are
    averaged."""
    torch.manual_seed(0)
    features = [FeatureMap(torch.randn(2, 8, 4, 6), 8)]
    T = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]).expand(1, 2, 4, 4).clone()
    K = torch.tensor([[20, 0, 24], [0, 20, 16], [0, 0, 1.0]]).expand(1, 2, 3, 3)
    pixels = torch.zeros(1, 2, 3, 32, 48, dtype=torch.uint8)
    points = torch.tensor([[[10.0, 1, 0], [-10, 0, 0]]])
    both = Views(pixels, K, T, torch.tensor([[True, True]]))
    found, seen = image_features(points, both, features)
    one, other = (
        image_features(points, both._replace(present=torch.tensor([present])), features)[0]
        for present in ([True, False], [False, True])
    )
    assert seen.tolist() == [[True, False]]
    torch.testing.assert_close(found, (one + other) / 2)
    assert found[0, 1].abs().max() == 0
    fusion = Encoder(tiny()).fusion
    assert fusion is not None
    assert fusion.pixel_in.weight.abs().max() == 0


@pytest.mark.parametrize("pool_first", [True, False])
def test_inference_gives_what_training_gives(noise: np.random.Generator, pool_first: bool) -> None:
    """The loops over neighbors in machine code equal those in torch to the rounding of float32, also for a batch."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny(points={"pool_first": pool_first})).eval()
    points = collate([build_pyramid(boxes(noise), model.settings) for _ in range(2)])
    with torch.no_grad():
        trained = model.encoder(points)
    with torch.inference_mode():
        inferred = model.encoder(points)
    for one, other in zip(trained.scales, inferred.scales, strict=True):
        torch.testing.assert_close(one.features, other.features, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(trained.tokens.features, inferred.tokens.features, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("image_mask", ["view", "front"])
def test_only_what_an_image_shows_is_asked_about_it(noise: np.random.Generator, cameras: int, image_mask: str) -> None:
    """At inference, only points in view query the image; the descriptors equal those of querying with all points."""
    torch.manual_seed(0)
    model = DeepPointMap2(tiny(fusion={"image_mask": image_mask})).eval()
    points = collate([build_pyramid(boxes(noise), model.settings)])
    image = make_image(noise)
    up = np.array([[0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 90], [0, 0, 0, 1.0]]) @ image.camera.T_lidar_cam
    sky = replace(image, camera=replace(image.camera, T_lidar_cam=up))
    for images in ([image, make_image(noise)][:cameras], [sky] * cameras):
        views = views_of(model, images)
        with torch.no_grad():
            trained, xyz = model.encoder(points, views).tokens.features, model.encoder(points).tokens.xyz
        assert bool(seen_from(xyz, views, 0).any()) is (images[0] is image)
        with torch.inference_mode():
            inferred = model.encoder(points, views).tokens.features
        torch.testing.assert_close(trained, inferred, atol=1e-4, rtol=1e-4)
