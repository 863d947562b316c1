# SPDX-License-Identifier: Apache-2.0
"""Encoder and decoder as one model."""

from __future__ import annotations

from torch import nn

from dpm2_core.network.decoder import Decoder
from dpm2_core.network.encoder import Encoder
from dpm2_core.network.settings import NetworkSettings


class DeepPointMap2(nn.Module):
    """The whole network."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder = Encoder(settings)
        self.decoder = Decoder(settings)
