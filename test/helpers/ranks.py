# SPDX-License-Identifier: Apache-2.0
"""Gradients of one training step on two places; under torchrun each process has one of them.

ranks.py OUT PACKED NETWORK: file to write, folder of packed drives, settings of the network as JSON.
"""

from __future__ import annotations

import sys
from pathlib import Path

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
    """By the names of the parameters; of more than one process, each of which has one of the places, their mean."""
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


def main(out: str, packed: str, network: str) -> None:
    """Write them, from the first rank."""
    with process_group() as (rank, world, _):
        found = gradients(packed, NetworkSettings.model_validate_json(network), rank, world)
        if rank == 0:
            torch.save(found, Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
