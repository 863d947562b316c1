# SPDX-License-Identifier: Apache-2.0
"""The weights that come with dpm2: where they are, and the network loaded with them. Imports torch only to load."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dpm2_core.errors import UsageError

if TYPE_CHECKING:  # torch takes seconds to import, and the geometric SLAM does without
    from dpm2_core.network.model import DeepPointMap2


PERCEPTION_WEIGHTS: dict[str, str] = {"movers": "movers", "ground": "gndnet", "static": "dslr"}
"""Names of the weights of each kind, and of the task that trains them."""
PRETRAINED_DIR = Path(__file__).resolve().parents[1] / "weights"
"""Folder of the weights that come with dpm2."""


def pretrained_names() -> Sequence[str]:
    """Names of the weights of the network that come with dpm2."""
    return sorted({path.stem for path in PRETRAINED_DIR.glob("*.safetensors")} - set(PERCEPTION_WEIGHTS.values()))


def weights_path(weights: str) -> Path:
    """The file of shipped weights by their name, or the file of that path.

    Raises:
        UsageError: there is neither.
    """
    if weights in pretrained_names():
        return PRETRAINED_DIR / f"{weights}.safetensors"
    if not Path(weights).is_file():
        names = ", ".join(pretrained_names()) or "none"
        raise UsageError(f"slam.neural.weights {weights}: no such file; weights that come with dpm2: {names}")
    return Path(weights)


def load_network(weights: str, threads: int, preset: str = "") -> DeepPointMap2:
    """The network with weights, ready to run on the CPU; without its camera if it was trained without images.

    Args:
        weights: name of shipped weights, or path of a .safetensors file.
        threads: of torch, which has one number for the whole process.
        preset: that the weights must be of; empty: any.

    Raises:
        UsageError: no such weights, or of another preset.
    """
    path = weights_path(weights)
    import torch

    from dpm2_core.network.weights import load_model, read_metadata

    torch.set_num_threads(threads)
    model = load_model(path)
    if read_metadata(path).get("images") != "true":
        model.encoder.image = None  # a branch that has never seen an image would only disturb
    if preset and model.settings.preset != preset:
        raise UsageError(f"{path}: weights of preset {model.settings.preset}, slam.neural.preset is {preset}")
    return model
