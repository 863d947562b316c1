# SPDX-License-Identifier: Apache-2.0
"""Weights as safetensors: nothing that is loaded can execute code, and nothing is loaded into the wrong network.

The network that a file describes is compared with the tensors in the file before any memory is allocated for it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from dpm2_core.config import Settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import atomic_write
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import NetworkSettings, settings_from

T = TypeVar("T", bound=Settings)
_MAX_NUMBER = 1 << 16  # no number in a description is greater: channels, points, pixels
_TIMM_NAME = re.compile(r"timm:[\w.]+")  # a network that timm itself builds; its other names are addresses


def save_weights(model: DeepPointMap2, path: Path, about: dict[str, str], half: bool = True) -> None:
    """Write all parameters with the network's settings; `half` stores fp16, half the size.

    Args:
        about: metadata. `load_network` reads two of them: without `images` "true" the camera is not used, and without
            `phase` "2" the overlap head counts as untrained.
    """
    metadata = {**about, "preset": model.settings.preset, "network": model.settings.model_dump_json()}
    write_tensors(model.state_dict(), path, metadata, half)


def write_tensors(state: Mapping[str, torch.Tensor], path: Path, metadata: dict[str, str], half: bool) -> None:
    """Write tensors and their metadata, completely or not at all; `half` stores fp16.

    The same tensors and metadata give the same bytes, by which weights are identified.

    Raises:
        Dpm2Error: a value is not finite, or too large for fp16, as after a training that diverged.
    """
    stored = {
        name: (value.half() if half and value.is_floating_point() else value).contiguous().cpu()
        for name, value in state.items()
    }
    if bad := [name for name, value in stored.items() if not bool(value.isfinite().all())]:
        raise Dpm2Error(f"{path}: not written: {bad[0]} holds values that are not finite{' in fp16' if half else ''}")
    with atomic_write(path, "wb") as file:
        file.write(_with_sorted_metadata(save(stored, metadata)))


def _with_sorted_metadata(file: bytes) -> bytes:
    """A safetensors file with its metadata sorted by name: the package writes it in the random order of a hash map."""
    end = 8 + int.from_bytes(file[:8], "little")
    header = json.loads(file[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # the tensors are aligned
    return len(text).to_bytes(8, "little") + text + file[end:]


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file.

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
    """The metadata of a weights file.

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
    _load_checked(model, path, state, metadata)
    return metadata


def load_fitting(model: DeepPointMap2, path: Path) -> list[str]:
    """Load the tensors that match one of the network in name and shape; returns the names of its others, which stay.

    Raises:
        UsageError: missing file, another format, values that are not finite, or nothing that fits.
    """
    state, _ = read_tensors(path)
    own = model.state_dict()
    fitting = {name: value for name, value in state.items() if name in own and own[name].shape == value.shape}
    if not fitting:
        raise UsageError(f"{path}: none of its tensors fits this network")
    _check_finite(path, fitting)
    model.load_state_dict(fitting, strict=False)
    return sorted(own.keys() - fitting.keys())


def _load_checked(
    model: DeepPointMap2, path: Path, state: Mapping[str, torch.Tensor], metadata: Mapping[str, str]
) -> None:
    stored = metadata.get("preset", "unknown")
    if stored != model.settings.preset:
        raise UsageError(f"{path}: weights of preset {stored}, but the network is of preset {model.settings.preset}")
    load_strictly(model, state, path, f"preset {stored}")


def load_strictly(module: nn.Module, state: Mapping[str, torch.Tensor], path: Path, what: str) -> None:
    """Load the tensors of a file into a module; `what`: what the file was made for.

    Raises:
        UsageError: names or shapes differ, or a value is not finite.
    """
    _check_shapes(module, state, f"{path}: does not fit {what}")
    _check_finite(path, state)
    module.load_state_dict(state)


def network_settings(path: Path) -> NetworkSettings:
    """Settings of the network that a weights file describes.

    Raises:
        UsageError: missing file, another format, no or invalid settings in it.
    """
    return _network_settings(path, read_metadata(path))


def load_model(path: Path) -> DeepPointMap2:
    """The network that a weights file describes, with its weights, ready for inference; a new one in every call.

    Raises:
        UsageError: as `load_weights`.
    """
    return load_model_and_metadata(path)[0]


def load_model_and_metadata(path: Path) -> tuple[DeepPointMap2, dict[str, str]]:
    """`load_model`, and the metadata of the weights; the file is opened once."""
    state, metadata = read_tensors(path)
    settings = _network_settings(path, metadata)
    check_fit(path, state, lambda: DeepPointMap2(settings))
    model = DeepPointMap2(settings)
    _load_checked(model, path, state, metadata)
    model.decoder.overlap_trained = metadata.get("phase") == "2"
    return model.eval().requires_grad_(False), metadata


def _network_settings(path: Path, metadata: Mapping[str, str]) -> NetworkSettings:
    if "task" in metadata:
        raise UsageError(f"{path}: weights of the task {metadata['task'][:40]!r}, not of the network of the SLAM")
    settings = described(path, metadata, NetworkSettings)
    backbone = settings.image.backbone
    if backbone.startswith("timm:") and not _TIMM_NAME.fullmatch(backbone):
        raise UsageError(
            f"{path}: image.backbone {backbone}: not allowed in a weights file, since it would start a download"
        )
    return settings


def described(path: Path, metadata: Mapping[str, str], kind: type[T]) -> T:
    """The settings of the network that a weights file describes.

    Raises:
        UsageError: no description, or values that no network can have.
    """
    if "network" not in metadata:
        raise UsageError(f"{path}: safetensors without a network description")
    try:
        tree = json.loads(metadata["network"])
    except (ValueError, RecursionError):
        raise UsageError(f"{path}: its network description is not JSON") from None
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: its network description is not a mapping")
    _check_numbers(path, tree)
    return settings_from(kind, tree, default=str(path))


def check_fit(path: Path, state: Mapping[str, torch.Tensor], make: Callable[[], nn.Module]) -> None:
    """Check that the tensors of a file are those of the network that `make` builds, before memory is allocated.

    Raises:
        UsageError: names or shapes differ, or such a network cannot be built.
    """
    try:
        with torch.device("meta"):
            network = make()
    except (ArithmeticError, AssertionError, IndexError, RuntimeError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: describes an invalid network: {' '.join(str(error).split())}") from None
    _check_shapes(network, state, f"{path}: does not fit the network that it describes")


def _check_shapes(model: nn.Module, state: Mapping[str, torch.Tensor], what: str) -> None:
    own = model.state_dict()
    differing = list(own.keys() ^ state.keys())
    differing += [name for name in own.keys() & state.keys() if own[name].shape != state[name].shape]
    if differing:
        raise UsageError(f"{what}: {len(differing)} tensors differ, such as {min(differing)}")


def _check_finite(path: Path, state: Mapping[str, torch.Tensor]) -> None:
    if bad := [name for name, value in state.items() if not bool(value.isfinite().all())]:
        raise UsageError(f"{path}: {bad[0]} holds values that are not finite")


def _check_numbers(path: Path, value: Any, name: str = "network") -> None:
    """Raise UsageError if a number or the length of a list in a description is above `_MAX_NUMBER`."""
    if isinstance(value, dict):
        for key, item in value.items():
            _check_numbers(path, item, f"{name}.{key}")
    elif isinstance(value, list):
        for item in [len(value), *value[:_MAX_NUMBER]]:
            _check_numbers(path, item, name)
    elif isinstance(value, int | float) and not abs(value) <= _MAX_NUMBER:
        raise UsageError(f"{path}: {name} is {value}; at most {_MAX_NUMBER} makes sense")
