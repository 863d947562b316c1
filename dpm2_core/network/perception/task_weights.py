# SPDX-License-Identifier: Apache-2.0
"""Weights of a task as safetensors: they contain the task and the settings of its network, and are rejected if they do
not fit both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from torch import Tensor, nn

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError
from dpm2_core.network.weights import check_fit, described, load_strictly, read_tensors, write_tensors

T = TypeVar("T", bound=Settings)
M = TypeVar("M", bound=nn.Module)


def write_weights(
    path: Path, name: str, network: Settings, state: Mapping[str, Tensor], about: dict[str, str], half: bool
) -> None:
    """Write the tensors of the task `name` and the settings of its network; `half` stores fp16."""
    write_tensors(state, path, {**about, "task": name, "network": network.model_dump_json()}, half)


def read_weights(path: Path, name: str, kind: type[T]) -> tuple[dict[str, Tensor], T]:
    """The tensors, and the settings of their network.

    Raises:
        UsageError: no such file, a pickle, weights of another task, or settings that are missing or wrong.
    """
    state, metadata = read_tensors(path)
    if metadata.get("task") != name:
        raise UsageError(f"{path}: weights of {metadata.get('task', 'no task')}, not of {name}")
    return state, described(path, metadata, kind)


def load_network(path: Path, name: str, part: str, kind: type[T], make: Callable[[T], M]) -> M:
    """The network of a trained task on the CPU, ready for inference, from what `dpm2 train NAME` wrote.

    Args:
        part: name of the network in the trained task. kind: its settings; `make` builds it from them.

    Raises:
        UsageError: no such file, a pickle, weights of another task, other settings or shapes, values not finite.
    """
    state, settings = read_weights(path, name, kind)
    check_fit(path, state, lambda: nn.ModuleDict({part: make(settings)}))
    network = make(settings)
    load_strictly(nn.ModuleDict({part: network}), state, path, "its settings")
    return network.eval().requires_grad_(False)
