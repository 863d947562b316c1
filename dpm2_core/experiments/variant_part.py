# SPDX-License-Identifier: Apache-2.0
"""Parts of the tables that compare networks: a drive packed for training, and one network trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dpm2_core.config import load_settings, merged
from dpm2_core.console import Advance
from dpm2_core.data.packed import PackedDrive, packed_digest
from dpm2_core.errors import UsageError
from dpm2_core.experiments.slam_part import open_drive
from dpm2_core.fleet.part import Figures
from dpm2_core.learning.begun import begin_training
from dpm2_core.learning.checkpoint import read_log
from dpm2_core.learning.generate import pack as write_packed_drive
from dpm2_core.learning.train_registration import RegistrationTrainingSettings, train_registration
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.weights import network_settings, read_metadata

PACK = "dpm2_core.experiments.variant_part:pack"
TRAIN = "dpm2_core.experiments.variant_part:train"
DRIVE = "drive"
"""The packed drive in the folder of a part that packs."""


def pack(folder: Path, advance: Advance, data: Path, settings: Sequence[str], weights: str) -> Figures:
    """Pack the frames of a sequence that have a pose below the folder, for the network of these weights.

    Raises:
        UsageError: no such sequence, no poses, or images of some frames only.
    """
    source = open_drive(data, settings)
    network = network_settings(weights_path(weights))
    return {"frames": write_packed_drive(source, folder / DRIVE, network, None, advance)}


def training_of(
    config: Path | None, settings: Sequence[str], start: str, network: dict[str, Any], packed: Sequence[Path]
) -> RegistrationTrainingSettings:
    """The training of a variant on packed drives, each weighted by its number of frames.

    `network`: its changes to the network of the weights that it starts from.

    Raises:
        UsageError: unknown settings, or settings with other weights or another network than those of `start`.
    """
    chosen = load_settings(RegistrationTrainingSettings, config, settings)
    path = weights_path(start)
    base = network_settings(path)
    if chosen.start:
        raise UsageError(f"start {chosen.start}: give the weights that all variants start from by --weights")
    if "preset" in chosen.model_fields_set and chosen.preset != base.preset:
        raise UsageError(f"preset {chosen.preset}: the weights --weights {start} are of the preset {base.preset}")
    tree = merged(merged(base.model_dump(mode="json"), chosen.network), network)
    data = chosen.data
    if not data.packed:
        images = any((drive / "pixels.npy").is_file() for drive in packed)
        frames = {str(drive): float(len(PackedDrive(drive))) for drive in packed}
        data = data.model_copy(update={"packed": frames, "images": images})
    # The changes define the whole network, its name included, so it does not matter which preset they change.
    changes = {"preset": "small", "network": tree, "start": str(path), "partial": True, "data": data}
    return chosen.model_copy(update=changes)


def train(
    folder: Path, advance: Advance, training: dict[str, Any], packed: Sequence[Path], network: dict[str, Any]
) -> Figures:
    """Fine-tune a variant of a network from weights, as far as they fit; a stopped training continues.

    Raises:
        UsageError: no such weights, or no packed drive.
    """
    chosen = training_of(**training, network=network, packed=packed)
    content = packed_digest(map(PackedDrive, packed))
    begin_training(folder, chosen, [Path(chosen.start)], {"content": content})
    weights = train_registration(chosen, folder)
    steps = chosen.optimiser.steps
    advance(steps, steps)
    last = [row["loss"] for row in read_log(folder) if row.get("loss") is not None][-50:]
    random = read_metadata(weights).get("random_at_start", "")
    return {"steps": steps, "last_loss": sum(last) / len(last), "random_at_start": random.split(", ") if random else []}
