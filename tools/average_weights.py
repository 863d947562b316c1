# SPDX-License-Identifier: Apache-2.0
"""The mean of the weights of several trainings that follow each other: python -m tools.average_weights OUT IN...

Stages of one training lie in one valley of the loss, and their mean errs less than each (M. Wortsman et al., "Model
soups", ICML 2022). What only the last one has, such as another overlap head, and its settings, are those of the last.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from dpm2_core.errors import UsageError, exit_code


def average(files: Sequence[Path]) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """The mean of each tensor, and the metadata of the last file.

    Raises:
        UsageError: no file, or one that is not readable weights.
    """
    if not files:
        raise UsageError("no weights to average")
    read = [_read(file) for file in files]
    last, about = read[-1]

    def mean(name: str, own: torch.Tensor) -> torch.Tensor:
        same = [tensors[name] for tensors, _ in read if name in tensors and tensors[name].shape == own.shape]
        if len(same) < len(read) or not own.is_floating_point():
            return own
        return torch.stack([tensor.double() for tensor in same]).mean(0).to(own.dtype)

    return {name: mean(name, own) for name, own in last.items()}, about


def _read(file: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    try:
        with safe_open(file, "pt") as weights:
            return {name: weights.get_tensor(name) for name in weights.keys()}, weights.metadata() or {}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise UsageError(f"{file}: {error}") from None


def main(arguments: Sequence[str]) -> None:
    """Write the mean.

    Raises:
        UsageError: fewer than two files, or one that is not readable weights.
    """
    if len(arguments) < 2:
        raise UsageError("want OUT IN...")
    tensors, about = average([Path(file) for file in arguments[1:]])
    out = Path(arguments[0])
    out.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, out, about)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
