# SPDX-License-Identifier: Apache-2.0
"""AE_lidar: the range-image autoencoder of Caccia et al., "Deep Generative Modeling of LiDAR Data" (IROS 2019)."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError
from dpm2_core.network.perception.dslr import down, initialize, up
from dpm2_core.network.perception.range_image import CHANNELS, RangeImageSettings


class AeLidarSettings(Settings):
    """Range image and size of the network; the default is the paper's."""

    image: RangeImageSettings = RangeImageSettings(scale=50)
    """Geometry of the scans. The paper cuts KITTI at percentiles that lie 50 m from the sensor at most."""
    channels: int = Field(default=64, ge=4)
    """Channels of the first layer; the innermost has eight times as many."""
    latent: int = Field(default=512, ge=8)
    """Length of the code of a scan."""
    variational: bool = False
    """A VAE: codes are drawn from a normal distribution that the encoder predicts."""


class LidarAutoencoder(nn.Module):
    """Autoencoder of images (B, 2, rows, columns), in units of their scale, through a code (B, latent)."""

    def __init__(self, settings: AeLidarSettings | None = None) -> None:
        """Default settings if None: 21.2 million parameters.

        Raises:
            UsageError: images whose number of rows is no multiple of 8 from 16 on.
        """
        super().__init__()
        self.settings = settings = settings or AeLidarSettings()
        rows, columns = settings.image.rows, settings.image.columns
        if rows < 16 or rows % 8:
            raise UsageError(f"AE_lidar: images of {rows} rows; want a multiple of 8, at least 16")
        c = settings.channels
        kernel = (3 if rows // 8 % 2 else 2, 4)  # halves an even number of rows, or an odd one minus one
        full_kernel = ((rows // 8 - kernel[0]) // 2 + 1, columns // 16)
        self.encoder = nn.Sequential(
            nn.Conv2d(CHANNELS, c, 4, 2, 1, bias=False),
            nn.LeakyReLU(0.2),
            *down(c, 2 * c, 4, 1),
            *down(2 * c, 4 * c, 4, 1),
            *down(4 * c, 8 * c, kernel, (0, 1)),
            nn.Conv2d(8 * c, settings.latent * (2 if settings.variational else 1), full_kernel, bias=False),
        )
        self.decoder = nn.Sequential(
            *up(settings.latent, 8 * c, full_kernel, 1, 0),
            *up(8 * c, 4 * c, kernel, 2, (0, 1)),
            *up(4 * c, 2 * c, 4, 2, 1),
            *up(2 * c, c, 4, 2, 1),
            nn.ConvTranspose2d(c, CHANNELS, 4, 2, 1, bias=False),
            nn.Tanh(),
        )
        self.apply(initialize)

    def encode(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Codes (B, latent), drawn in training and the mean otherwise if variational, and their divergence (B,).

        The divergence is that of Kullback and Leibler from the standard normal distribution, zero for an autoencoder.
        """
        code = self.encoder(images)[:, :, 0, 0]
        if not self.settings.variational:
            return code, code.new_zeros(len(code))
        mean, log_variance = code.chunk(2, 1)
        divergence = (mean**2 + log_variance.exp() - 1 - log_variance).sum(1) / 2
        if self.training:
            mean = mean + torch.randn_like(mean) * (log_variance / 2).exp()
        return mean, divergence

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Images made from the codes, and the divergence (B,)."""
        code, divergence = self.encode(images)
        return self.decoder(code[:, :, None, None]), divergence
