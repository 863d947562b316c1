# SPDX-License-Identifier: Apache-2.0
"""Averages the weights of consecutive training stages: python -m tools.average_weights OUT IN...

The stages of one training are in one basin of the loss, and their mean has a smaller error than each (M. Wortsman et
al., "Model soups", ICML 2022). The resulting network is the preset, whatever a stage has changed for its training.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer

from dpm2_core.commands.options import run_command
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import preset
from dpm2_core.network.weights import load_fitting, network_settings, read_metadata, save_weights


def average(files: Sequence[Path]) -> DeepPointMap2:
    """The preset's network with the mean of the weights; tensors that do not fit in all files are from the last file.

    Raises:
        UsageError: a file is not readable weights, or none of its weights fit.
    """
    model = DeepPointMap2(preset(network_settings(files[-1]).preset))
    states, not_fitting = [], set[str]()
    for file in files:
        not_fitting.update(load_fitting(model, file))
        states.append({name: tensor.double() for name, tensor in model.state_dict().items()})
    mean = {name: torch.stack([state[name] for state in states]).mean(0) for name in states[-1].keys() - not_fitting}
    model.load_state_dict(states[-1] | mean)
    return model


def average_weights(
    out: Annotated[Path, typer.Argument(help="Weights file to write.")],
    files: Annotated[list[Path], typer.Argument(metavar="IN...", help="Weights files of the stages, in order.")],
    encoder: Annotated[Path | None, typer.Option(help="Weights file whose encoder replaces the mean.")] = None,
) -> None:
    """Write the mean of weights; the averaged decoder may be combined with the encoder of another stage."""
    model = average(files)
    if encoder is not None:
        model.encoder.load_state_dict(average([encoder]).encoder.state_dict())
    out.parent.mkdir(parents=True, exist_ok=True)
    save_weights(model, out, read_metadata(files[-1]))


if __name__ == "__main__":
    sys.exit(run_command(average_weights))
