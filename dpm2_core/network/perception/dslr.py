# SPDX-License-Identifier: Apache-2.0
"""DSLR (Kumar et al., AAAI 2021): removes moving objects from a scan, by an adversarially trained autoencoder.

An autoencoder learns static scans. A discriminator learns to distinguish a pair of static codes from a static and a
dynamic one. Then a copy of the encoder learns to map dynamic scans to codes that the discriminator takes for static and
that decode to the static twin.
"""

from __future__ import annotations

import copy
from itertools import pairwise
from pathlib import Path

import torch
from pydantic import Field
from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError
from dpm2_core.network.perception.range_image import (
    CHANNELS,
    RangeImageSettings,
    fill,
    project,
    slots,
    to_points,
)
from dpm2_core.network.perception.task_weights import load_network

_MAX_ROWS = 42  # rows that the decoder makes; the image is cropped from them


class DslrSettings(Settings):
    """Range image and size of the network; the default is the paper's."""

    image: RangeImageSettings = RangeImageSettings()
    """Geometry of the scans, at most 42 rows."""
    channels: int = Field(default=64, ge=4)
    """Channels of the first layer; the innermost has eight times as many."""
    latent: int = Field(default=160, ge=8, multiple_of=8)
    """Length of the code of a scan."""


class RangeEncoder(nn.Module):
    """Images (B, 2, rows, columns) to codes (B, latent). The layers read the points of the slots."""

    def __init__(self, settings: DslrSettings) -> None:
        """Default settings: 2.544 million parameters."""
        super().__init__()
        c, image = settings.channels, settings.image
        height = image.rows
        for kernel in (4, 4, 3, 3, 3):
            height = (height + 2 - kernel) // 2 + 1
        self.layers = nn.Sequential(
            *down(3, c, 4, norm=False),
            *down(c, 2 * c, 4, norm=False),
            *down(2 * c, 2 * c, 3),
            *down(2 * c, 4 * c, 3, norm=False),
            *down(4 * c, 4 * c, 3),
            *down(4 * c, 8 * c, (height, 4), (0, 1)),
            nn.Conv2d(8 * c, settings.latent, (1, image.columns // 64), bias=False),
        )

    def forward(self, images: Tensor) -> Tensor:
        """Codes."""
        points = to_points(images, 1.0).mT.unflatten(2, images.shape[2:])
        return self.layers(points)[:, :, 0, 0]


class RangeDecoder(nn.Module):
    """Codes (B, latent) to images (B, 2, rows, columns) in -1..1."""

    def __init__(self, settings: DslrSettings) -> None:
        """Default settings: 2.987 million parameters."""
        super().__init__()
        c, self.rows = settings.channels, settings.image.rows
        self.layers = nn.Sequential(
            *up(settings.latent, 8 * c, (1, settings.image.columns // 64), 1, 0),
            *up(8 * c, 4 * c, (2, 4), 2, (0, 1)),
            *up(4 * c, 4 * c, (4, 4), 2, 1),
            *up(4 * c, 2 * c, (3, 4), 2, 1),
            *up(2 * c, 2 * c, (2, 4), 2, 1),
            *up(2 * c, c, (1, 4), 2, 1),
            nn.ConvTranspose2d(c, CHANNELS, 4, 2, 1, bias=False),
            nn.Tanh(),
        )

    def forward(self, codes: Tensor) -> Tensor:
        """Images; the rows that the layers make beyond those of the image are cut off."""
        return self.layers(codes[:, :, None, None])[:, :, : self.rows]


class PairDiscriminator(nn.Module):
    """Two codes (B, latent) each to a logit (B,): positive if both are taken for static scans.

    It has leaky units; sigmoids, as in the original, hardly pass a gradient through five layers.
    """

    def __init__(self, settings: DslrSettings) -> None:
        """Default settings: 68 thousand parameters."""
        super().__init__()
        n = settings.latent
        widths = (2 * n, n, n // 2, n // 4, n // 8)
        hidden = [m for a, b in pairwise(widths) for m in (nn.Linear(a, b), nn.LeakyReLU(0.2))]
        self.layers = nn.Sequential(*hidden, nn.Linear(n // 8, 1))

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Logits."""
        return self.layers(torch.cat([first, second], 1))[:, 0]


class Dslr(nn.Module):
    """The networks: the static encoder and the decoder are an autoencoder, the dynamic encoder learns from them."""

    def __init__(self, settings: DslrSettings | None = None) -> None:
        """Default settings if None.

        Raises:
            UsageError: an image of more than 42 rows.
        """
        super().__init__()
        self.settings = settings = settings or DslrSettings()
        if settings.image.rows > _MAX_ROWS:
            raise UsageError(f"DSLR: images of {settings.image.rows} rows; want at most {_MAX_ROWS}")
        self.static_encoder, self.decoder = RangeEncoder(settings), RangeDecoder(settings)
        self.discriminator = PairDiscriminator(settings)
        self.apply(initialize)
        self.dynamic_encoder = copy.deepcopy(self.static_encoder)

    def forward(self, images: Tensor) -> Tensor:
        """Static images (B, 2, rows, columns) of dynamic ones, filled, in units of their scale."""
        return self.decoder(self.dynamic_encoder(images))

    @torch.no_grad()
    def translate(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Image (2, rows, columns) of the static scan, and (rows, columns) bool, the slots with a point of the scan.

        Args:
            points: (N, 3+) m; those outside the image are not used.
        """
        image, mask = project(points.float(), self.settings.image)
        return self(fill(image, mask)[None])[0], mask

    def still(self, points: Tensor) -> Tensor:
        """(N,) bool: which points (N, 3+), m, are not `in_front` of the static scan, or are outside the image."""
        image, _ = self.translate(points)
        slot, inside = slots(points, self.settings.image)
        d = torch.hypot(points[:, 0], points[:, 1]) / self.settings.image.scale
        return ~(self.in_front(d, image[0].flatten()[slot]) & inside)

    def in_front(self, d: Tensor, static: Tensor) -> Tensor:
        """Where distances (...), in units of the scale, are so much less than those of the static scan that a temporary
        object must be in between: by a fifth and a meter, which is more than the error of the translation."""
        return d < 0.8 * static - 1.0 / self.settings.image.scale

    def static_points(self, points: Tensor) -> Tensor:
        """The translated scan (M, 3), m: one point for each slot in which the scan (N, 3+) has a point."""
        image, mask = self.translate(points)
        return to_points(image, self.settings.image.scale)[mask.flatten()]


def load(path: Path) -> Dslr:
    """A trained translator, ready for inference on the CPU; raises as `task_weights.load_network`."""
    return load_network(path, "dslr", "network", DslrSettings, Dslr)


def initialize(module: nn.Module) -> None:
    """Set the initial weights of the original: normal, with a standard deviation of 0.02."""
    if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
        nn.init.normal_(module.weight, 0.0, 0.02)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, 0.02)
        nn.init.zeros_(module.bias)


def down(
    inputs: int,
    outputs: int,
    kernel: int | tuple[int, int],
    padding: int | tuple[int, int] = 1,
    norm: bool = True,
) -> list[nn.Module]:
    """Layers of an encoder: half the size."""
    between: list[nn.Module] = [nn.BatchNorm2d(outputs)] if norm else []
    return [nn.Conv2d(inputs, outputs, kernel, 2, padding, bias=False), *between, nn.LeakyReLU(0.2)]


def up(
    inputs: int, outputs: int, kernel: int | tuple[int, int], stride: int, padding: int | tuple[int, int]
) -> list[nn.Module]:
    """Layers of a decoder: twice the size, or as the kernel determines."""
    return [
        nn.ConvTranspose2d(inputs, outputs, kernel, stride, padding, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    ]
