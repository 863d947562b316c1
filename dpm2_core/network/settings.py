# SPDX-License-Identifier: Apache-2.0
"""Shape of the network: typed, with the presets `paper`, `base` and `small` and the DeepPointMap v1 mode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from dpm2_core.config import Settings, merged, read_yaml, settings_from
from dpm2_core.errors import UsageError

FusionKind = Literal[
    "none", "biased", "point_painting", "roi_pooling", "scale_dot", "without_learnable", "without_spatial"
]


class StageSettings(Settings):
    """One resolution of the point backbone."""

    points: int = Field(gt=0)
    """Points kept by farthest point sampling."""
    radius: float = Field(gt=0)
    """Radius of the set abstraction, m."""
    neighbours: int = Field(gt=0)
    """Neighbors in the set abstraction."""
    channels: int = Field(gt=0)
    """Output channels."""
    residual_radii: tuple[float, ...] = Field((), max_length=64)
    """Radius of each inverted residual block, m."""
    residual_neighbours: int = Field(16, gt=0)
    """Neighbors in the inverted residual blocks."""


class PointsSettings(Settings):
    """The LiDAR side: preprocessing and point backbone."""

    backbone: Literal["pointnext"] = "pointnext"
    """Point backbone: the only one."""
    voxel: float = Field(0.3, gt=0)
    """Edge of the input voxel grid, m."""
    near: float = Field(1.0, ge=0)
    """Points nearer than this are dropped, m."""
    far: float = Field(60.0, gt=0)
    """Points farther than this are dropped, and the unit of the network's coordinates, m."""
    view_aligned: bool = True
    """Express every neighborhood in the frame whose x axis points horizontally away from the sensor. Features and
    offsets then do not change with the heading of the vehicle. False: the sensor's axes, as in the paper."""
    moments: bool = True
    """Add mean and scatter matrix of each first-stage neighborhood to its features: the local surface, explicitly."""
    pool_first: bool = True
    """Take the maximum over neighbors before normalizing: several times faster. False: after, as PointNeXt does."""
    stem: int = Field(16, gt=0)
    """Channels of the point-wise stem."""
    stages: tuple[StageSettings, ...] = Field(
        (
            StageSettings(points=2048, radius=1.5, neighbours=16, channels=32),
            StageSettings(points=512, radius=4, neighbours=24, channels=96, residual_radii=(8,)),
            StageSettings(points=256, radius=8, neighbours=24, channels=128, residual_radii=(12,)),
            StageSettings(points=64, radius=24, neighbours=24, channels=192),
        ),
        min_length=1,
    )
    """From fine to coarse; the points of each are the first ones of the stage before."""
    upsample: int = Field(0, ge=0, le=16)
    """Feature propagation steps from the coarsest stage back up."""


class ImageSettings(Settings):
    """The camera side."""

    backbone: str = "convnext"
    """`convnext`, `timm:NAME` with the optional extra, or `none`: LiDAR only."""
    size: tuple[int, int] = (128, 416)
    """Height and width that images are resized to, pixels."""
    depths: tuple[Annotated[int, Field(gt=0, le=64)], ...] = Field((1, 1, 2, 1), max_length=16)
    """ConvNeXt blocks of each stage."""
    channels: tuple[int, ...] = (24, 48, 96, 128)
    """ConvNeXt channels of each stage."""
    pyramid: int = Field(64, gt=0)
    """Channels of the feature pyramid."""
    strides: tuple[int, ...] = (8, 16)
    """Levels of the pyramid whose pixels become tokens."""


class FusionSettings(Settings):
    """Reference points and multi-modal transformer."""

    kind: FusionKind = "biased"
    """How LiDAR and image features reach the reference points. none is DeepPointMap v1, with the backbone's own points.
    All except biased and none are the alternatives of the paper's Table 4. point_painting gives every point of the
    cloud the color of its pixel before the point backbone, and has no image backbone."""
    reference: Literal["salient", "fps", "uniform", "normal"] = "salient"
    """How reference points are chosen: image corners, vertical edges and poles of the cloud among its farthest points,
    farthest points alone, or random positions. The last three are those of the paper's Table 3."""
    edges: float = Field(0.5, ge=0, le=1)
    """Ratio of the reference points, image corners excluded, that `salient` puts on vertical edges; fewer if a scan
    shows fewer."""
    corners: float = Field(0, ge=0, le=1)
    """Ratio of the reference points that `salient` puts on image corners with the depth of the scan. The descriptor of
    each contains the texture around it. Fewer if the images show fewer, none without an image."""
    points: int = Field(256, gt=0)
    """Number of reference points."""
    reference_features: bool = True
    """Start a reference point from the backbone's features if it is one of its points; False: from xyz alone."""
    layers: int = Field(3, gt=0, le=64)
    """Multi-modal transformer layers."""
    heads: int = Field(4, gt=0, le=256)
    """Attention heads."""
    alpha_lidar: float = Field(0.1, gt=0)
    """Decay of the point-to-point bias, 1/m."""
    alpha_image: tuple[float, ...] = (0.3, 1.0, 2.5, 6.0)
    """Decay of the point-to-ray bias, 1/m: one for all heads, or one per head."""
    learned_gain: bool = True
    """A learned factor per head and branch on the z-scored spatial bias; False: 1, as in the paper."""
    levels: tuple[int, ...] = (1, 3)
    """Backbone levels, 0 the finest, whose key-points the LiDAR branch reads."""
    relative: bool = True
    """Add to the attention among reference points a learned bias, given by where one lies as seen from the other."""
    pixel: bool = True
    """Add to a descriptor the image feature at the pixel of its reference point. Along a tunnel, the texture at that
    pixel distinguishes places, and through the attention this takes long to learn. False: as in the paper."""
    image_mask: Literal["view", "front"] = "view"
    """Which reference points read an image. `view`: those that project into it. `front`: all, as in the paper; pixels
    whose rays point away count as far."""


class DecoderSettings(Settings):
    """Correlation of two descriptor sets, and the heads."""

    width: int = Field(128, gt=0)
    """Channels."""
    layers: int = Field(3, gt=0, le=64)
    """Self and cross attention layers."""
    heads: int = Field(4, gt=0, le=256)
    """Attention heads."""
    position: Literal["sine", "relative"] = "relative"
    """`sine`: code of absolute coordinates added before each attention, as in DeepPointMap. `relative`: a learned bias
    from where one descriptor lies as seen from the other; it does not depend on origin or heading."""
    precision: bool = True
    """Predict with each offset its 3x3 precision (inverse covariance), and weight the offset in the pose with it."""
    temperature: float = Field(0.1, gt=0)
    """Temperature of the dual softmax over similarities."""
    pair_ratio: float = Field(0.5, gt=0, le=1)
    """Pairs used for the pose: floor(ratio * (M + N)) // 2 of the most similar."""
    offset_limit: float = Field(2.0, gt=0)
    """Pairs with a longer predicted offset are dropped, m."""
    guided: int = Field(2, ge=0, le=64)
    """Number of times that descriptors are matched again with the current pose. 0: the paper's single matching."""
    overlap_pose: bool = True
    """The overlap head reads the registration of a pair: how much of the pair fits, how well the matches support it,
    and the distance. False: it reads the descriptors, as in the paper."""
    covariance_scale: float = Field(4.0, gt=0)
    """Factor on the covariance of the pose: both directions of a pair, and neighboring pairs, have similar errors."""


class NetworkSettings(Settings):
    """The whole network."""

    preset: str = "small"
    """Name that weights are stored under and checked against."""
    channels: int = Field(128, gt=0)
    """Channels of a descriptor."""
    points: PointsSettings = PointsSettings()
    image: ImageSettings = ImageSettings()
    fusion: FusionSettings = FusionSettings()
    decoder: DecoderSettings = DecoderSettings()


PRESETS = ("small", "base", "paper", "v1")
"""Files of changes to these defaults, in the folder `presets`."""


def preset(name: str, changes: Mapping[str, Any] | None = None) -> NetworkSettings:
    """Settings by name, with changes such as {"fusion": {"layers": 2}}.

    Raises:
        UsageError: no such preset, a change that its settings do not allow, or changes that do not fit each other.
    """
    if name not in PRESETS:
        raise UsageError(f"network preset {name}: want one of {', '.join(PRESETS)}")
    path = Path(__file__).with_name("presets") / f"{name}.yaml"
    settings = settings_from(NetworkSettings, merged(read_yaml(path), changes or {}), default=f"preset {name}")
    if misfits := [*_misfits(settings)]:
        raise UsageError(f"preset {name} with these changes is not a valid network: {'; '.join(misfits)}")
    return settings


def _misfits(s: NetworkSettings) -> Iterator[str]:
    """The settings that do not fit each other, in words."""
    fusion, decoder = s.fusion, s.decoder
    sizes = [stage.points for stage in s.points.stages]
    if sorted(sizes, reverse=True) != sizes:
        yield f"points.stages have {sizes} points, want no more than the stage before"
    if s.points.upsample >= len(sizes):
        yield f"points.upsample {s.points.upsample} of {len(sizes)} stages"
    if decoder.width % decoder.heads:
        yield f"decoder.width {decoder.width} is no multiple of decoder.heads {decoder.heads}"
    if s.image.backbone == "convnext":
        yield from _misfits_of_convnext(s.image)
    if fusion.kind == "none":
        level = len(sizes) - 1 - s.points.upsample
        if level >= 0 and (own := s.points.stages[level].channels) != s.channels:
            yield f"channels {s.channels}: without fusion those of points.stages.{level}, which has {own}"
        return
    if s.channels % fusion.heads:
        yield f"channels {s.channels} is no multiple of fusion.heads {fusion.heads}"
    if not set(fusion.levels) <= set(range(len(sizes))):
        yield f"fusion.levels {list(fusion.levels)}: want some of 0 to {len(sizes) - 1}"
    if fusion.reference == "salient" and fusion.points > sizes[0]:
        yield f"fusion.points {fusion.points}: the first of points.stages has {sizes[0]}"
    if len(fusion.alpha_image) not in (1, fusion.heads):
        yield f"fusion.alpha_image has {len(fusion.alpha_image)} values, want 1 or one of each of {fusion.heads} heads"


def _misfits_of_convnext(image: ImageSettings) -> Iterator[str]:
    if len(image.depths) != len(image.channels):
        yield f"image.depths has {len(image.depths)} stages, image.channels {len(image.channels)}"
    strides = [4 << stage for stage in range(len(image.channels))]
    if not set(image.strides) <= set(strides):
        yield f"image.strides {list(image.strides)}: want some of {', '.join(map(str, strides))}"
