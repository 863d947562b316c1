# SPDX-License-Identifier: Apache-2.0
"""The mean of the weights of stages that follow each other: python -m tools.average_weights OUT IN...

Stages of one training lie in one valley of the loss, and their mean errs less than each (M. Wortsman et al., "Model
soups", ICML 2022). Its network is the preset, whatever a stage has changed for its training.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from dpm2_core.errors import UsageError, exit_code
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import preset
from dpm2_core.network.weights import load_fitting, network_settings, read_metadata, save_weights


def average(files: Sequence[Path]) -> DeepPointMap2:
    """The network of the preset with the mean of the weights; what does not fit in all files is that of the last one.

    Raises:
        UsageError: one is not readable weights, or none of it fits.
    """
    model = DeepPointMap2(preset(network_settings(files[-1]).preset))
    states, partly = [], set[str]()
    for file in files:
        partly.update(load_fitting(model, file))
        states.append({name: tensor.double() for name, tensor in model.state_dict().items()})
    mean = {name: torch.stack([state[name] for state in states]).mean(0) for name in states[-1].keys() - partly}
    model.load_state_dict(states[-1] | mean)
    return model


def main(arguments: Sequence[str]) -> None:
    """Write the mean.

    Raises:
        UsageError: no files are named, or as `average`.
    """
    if len(arguments) < 2:
        raise UsageError("want OUT IN...")
    out, *files = map(Path, arguments)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_weights(average(files), out, read_metadata(files[-1]))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
