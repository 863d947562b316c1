# SPDX-License-Identifier: Apache-2.0
"""The weights that come with dpm2: their files, and the network loaded with them. Imports torch only to load."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar, cast

from safetensors import SafetensorError, deserialize, safe_open

from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.imports import importing
from dpm2_core.openmp import allowed

if TYPE_CHECKING:  # torch takes seconds to import, and the geometric SLAM does not need it
    from dpm2_core.network.model import DeepPointMap2

M = TypeVar("M")
PERCEPTION_WEIGHTS: dict[str, str] = {"movers": "movers", "ground": "gndnet", "static": "dslr"}
"""Name of the weights of each kind, which is also the task that trains them."""
DYNAMIC = 0.4
"""Probability from which a point counts as part of a dynamic object: the best of 0.3, 0.35, 0.4 and 0.5 on the three
kinds of validation worlds."""
PRETRAINED_DIR = Path(__file__).resolve().parents[1] / "weights"
"""Folder of the weights that come with dpm2."""
_LOCK = Lock()
_LOADED: dict[tuple[Path, Callable[[Path], Any]], tuple[tuple[int, int], Any]] = {}
"""By file and loader: the file's (mtime ns, size) when it was loaded, and the network."""


def pretrained_names() -> Sequence[str]:
    """Names of the weights of the network that come with dpm2."""
    return sorted({path.stem for path in PRETRAINED_DIR.glob("*.safetensors")} - set(PERCEPTION_WEIGHTS.values()))


def weights_path(weights: str) -> Path:
    """The file of shipped weights by their name, or the file of that path.

    Raises:
        UsageError: neither exists.
    """
    if weights in pretrained_names():
        return PRETRAINED_DIR / f"{weights}.safetensors"
    path = Path(os.path.expanduser(weights))
    if not path.is_file():
        names = ", ".join(pretrained_names()) or "none"
        raise UsageError(f"weights {weights}: no such file; weights shipped with dpm2: {names}")
    return path


def weights_id(weights: str) -> str:
    """Identifier of the descriptors that weights produce: name, and the first 16 digits of the SHA-256 of the encoder.

    Weights that differ only in the decoder have the same identifier: they read the descriptors of existing maps.

    Args:
        weights: name of shipped weights, or path of a file.

    Raises:
        UsageError: neither exists, or the file contains no weights. Dpm2Error: the file cannot be read.
    """
    path = weights_path(weights)
    try:
        with safe_open(path, "np") as file:
            network = dict(json.loads((file.metadata() or {}).get("network", "{}")))
        tensors = sorted(deserialize(path.read_bytes()))
    except OSError as error:
        raise Dpm2Error(f"{path}: {error.strerror or error}") from None
    except (SafetensorError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: not weights: {error}") from None
    network.pop("decoder", None)
    digest = sha256(json.dumps(network, sort_keys=True).encode())
    for name, tensor in tensors:
        if name.startswith("encoder."):
            digest.update(f"{name} {tensor['dtype']} {tensor['shape']}".encode())
            digest.update(tensor["data"])
    return f"{path.stem} {digest.hexdigest()[:16]}"


def load_once(path: Path, threads: int, load: Callable[[Path], M]) -> M:
    """The network in a weights file: the first call in this process loads it, later calls get the same weights.

    A file that has changed since is loaded again.

    Args:
        threads: of torch, one number for the whole process; it is set only here.
        load: makes the network, ready for inference.

    Returns:
        A separate object for each caller, so that callers do not share what the network caches, in this thread or in
        another one. Its layers are shared: do not train them.

    Raises:
        UsageError: as `load`, and for a missing file.
    """
    with importing():
        import torch

    torch.set_num_threads(allowed(threads))
    try:
        file = path.resolve(strict=True)
        stat = file.stat()
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    key, version = (file, load), (stat.st_mtime_ns, stat.st_size)
    with _LOCK:
        if key not in _LOADED or _LOADED[key][0] != version:
            _LOADED[key] = (version, load(path))
        network = copy.copy(_LOADED[key][1])  # of the object only: the layers are shared
    return cast(M, network)


def load_network(weights: str, threads: int) -> DeepPointMap2:
    """The network with weights, ready to run on the CPU; without its camera if it was trained without images.

    The weights are loaded once in a process, see `load_once`: all callers share the layers, which are frozen. To train
    from them, use `network.weights.load_weights` or `load_fitting`.

    Args:
        weights: name of shipped weights, or path of a .safetensors file.
        threads: of torch, one number for the whole process.

    Raises:
        UsageError: no such weights.
    """
    return load_once(weights_path(weights), threads, _load)


def _load(path: Path) -> DeepPointMap2:
    with importing():
        from dpm2_core.network.weights import load_model_and_metadata

    model, metadata = load_model_and_metadata(path)
    if metadata.get("images") != "true":
        model.encoder.image = None  # a branch trained without images would only do harm
    return model
