# SPDX-License-Identifier: Apache-2.0
"""Weights as safetensors: nothing that is loaded can execute code, and nothing is loaded into the wrong network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from dpm2_core.errors import UsageError
from dpm2_core.network.config import NetworkSettings, settings_from
from dpm2_core.network.model import DeepPointMap2


def save_weights(model: DeepPointMap2, path: Path, about: dict[str, str], half: bool = True) -> None:
    """Write all parameters with the network's settings; `half` stores fp16, half the size."""
    metadata = {**about, "preset": model.settings.preset, "network": model.settings.model_dump_json()}
    write_tensors(model.state_dict(), path, metadata, half)


def write_tensors(state: Mapping[str, torch.Tensor], path: Path, metadata: dict[str, str], half: bool) -> None:
    """Write tensors and what is to be known of them, whole or not at all; `half` stores fp16."""
    stored = {
        name: (value.half() if half and value.is_floating_point() else value).contiguous().cpu()
        for name, value in state.items()
    }
    part = path.with_suffix(".part")
    save_file(stored, part, metadata)
    part.replace(path)


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Tensors of a safetensors file, and what was written about them.

    Raises:
        UsageError: missing file, or another format.
    """
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except FileNotFoundError:
        raise UsageError(f"{path}: no such weights") from None
    except (SafetensorError, OSError) as error:
        raise UsageError(f"{path}: not a safetensors file ({error}); pickled weights are never loaded") from None


def read_metadata(path: Path) -> dict[str, str]:
    """What was written about the weights beside them.

    Raises:
        UsageError: missing file, or another format.
    """
    return read_tensors(path)[1]


def load_weights(model: DeepPointMap2, path: Path) -> dict[str, str]:
    """Load strictly; returns the metadata.

    Raises:
        UsageError: missing file, another format, weights of another preset or shape.
    """
    state, metadata = read_tensors(path)
    stored = metadata.get("preset", "unknown")
    if stored != model.settings.preset:
        raise UsageError(f"{path}: weights of preset {stored}, the network is preset {model.settings.preset}")
    own = model.state_dict()
    wrong = list(own.keys() ^ state.keys()) + [
        name for name in own.keys() & state.keys() if own[name].shape != state[name].shape
    ]
    if wrong:
        raise UsageError(f"{path}: does not fit preset {stored}: {len(wrong)} tensors differ, such as {min(wrong)}")
    model.load_state_dict(state)
    return metadata


def network_settings(path: Path) -> NetworkSettings:
    """Settings of the network that a weights file describes.

    Raises:
        UsageError: missing file, another format, no or invalid settings in it.
    """
    metadata = read_metadata(path)
    if "network" not in metadata:
        raise UsageError(f"{path}: safetensors without a network description")
    return settings_from(NetworkSettings, json.loads(metadata["network"]), default=str(path))


def load_model(path: Path) -> DeepPointMap2:
    """The network that a weights file describes, with its weights, ready for inference.

    Raises:
        UsageError: as `load_weights`.
    """
    model = DeepPointMap2(network_settings(path))
    model.decoder.judges_overlap = load_weights(model, path).get("phase") == "2"
    return model.eval().requires_grad_(False)
