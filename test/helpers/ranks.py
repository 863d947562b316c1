# SPDX-License-Identifier: Apache-2.0
"""Gradients of one training step on two places; with two processes, each has one of the places.

ranks.py PACKED NETWORK: folder of packed drives, settings of the network as JSON.
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from dpm2_core.learning.dataset import DataSettings, GroupDataset
from dpm2_core.learning.registration_loss import LossSettings
from dpm2_core.learning.train_registration import (
    RegistrationTraining,
    RegistrationTrainingSettings,
    set_pairs_of,
)
from dpm2_core.learning.trainer import process_group
from dpm2_core.network.settings import NetworkSettings


def gradients(packed: str, network: NetworkSettings, rank: int = 0, world: int = 1) -> dict[str, Tensor]:
    """Gradients by parameter name. With several processes, each has one of the places, and the result is the mean."""
    settings = RegistrationTrainingSettings(pairs=2, sets=0)
    torch.manual_seed(0)
    module = RegistrationTraining(network, LossSettings(near=16, own=8))
    run = DistributedDataParallel(module, find_unused_parameters=True) if world > 1 else module
    shares = [rank] if world > 1 else [0, 1]
    for share in shares:
        options = DataSettings(packed={packed: 1.0}, groups=1, frames=2, workers=0)
        batch = GroupDataset(options, network, options.draw, 0)[0, share]
        torch.manual_seed(1)
        loss, _ = run(batch.points, None, set_pairs_of(batch.poses, settings, 0))
        (loss / len(shares)).backward()
    return {name: p.grad for name, p in module.named_parameters() if p.grad is not None}


def main(packed: str, network: str) -> dict[str, Tensor]:
    """Gradients of all processes, in each of them."""
    with process_group() as (rank, world, _):
        return gradients(packed, NetworkSettings.model_validate_json(network), rank, world)


if __name__ == "__main__":
    main(*sys.argv[1:])
