# SPDX-License-Identifier: Apache-2.0
"""The weights that come with dpm2: where they are, and the network loaded with them. Imports torch only to load."""

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

if TYPE_CHECKING:  # torch takes seconds to import, and the geometric SLAM does without
    from dpm2_core.network.model import DeepPointMap2

M = TypeVar("M")
PERCEPTION_WEIGHTS: dict[str, str] = {"movers": "movers", "ground": "gndnet", "static": "dslr"}
"""Names of the weights of each kind, and of the task that trains them."""
DYNAMIC = 0.4
"""Probability from which a point is taken for one of a dynamic object: of 0.3, 0.35, 0.4 and 0.5 the best on the three
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
        UsageError: there is neither.
    """
    if weights in pretrained_names():
        return PRETRAINED_DIR / f"{weights}.safetensors"
    path = Path(os.path.expanduser(weights))
    if not path.is_file():
        names = ", ".join(pretrained_names()) or "none"
        raise UsageError(f"weights {weights}: no such file; weights that come with dpm2: {names}")
    return path


def weights_id(weights: str) -> str:
    """What identifies the descriptors that weights make: name, and the first 16 digits of the SHA-256 of the encoder.

    Weights with another decoder have the same: it reads the descriptors of a map that was made before.

    Args:
        weights: name of shipped weights, or path of a file.

    Raises:
        UsageError: there is neither, or it is no weights. Dpm2Error: the file cannot be read.
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
        threads: of torch, which has one number for the whole process; the only place that sets it.
        load: makes the network, ready for inference.

    Returns:
        An object of the caller's own, so that what one caller's network remembers is not mixed up with another's, in
        this thread or in another one. Its layers are shared: do not train them.

    Raises:
        UsageError: as `load`, and for a file that is not there.
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
        network = copy.copy(_LOADED[key][1])  # of the object alone, not of the layers in it
    return cast(M, network)


def load_network(weights: str, threads: int) -> DeepPointMap2:
    """The network with weights, ready to run on the CPU; without its camera if it was trained without images.

    The weights are loaded once in a process, see `load_once`.

    Args:
        weights: name of shipped weights, or path of a .safetensors file.
        threads: of torch, which has one number for the whole process.

    Raises:
        UsageError: no such weights.
    """
    return load_once(weights_path(weights), threads, _load)


def _load(path: Path) -> DeepPointMap2:
    with importing():
        from dpm2_core.network.weights import load_model_and_metadata

    model, metadata = load_model_and_metadata(path)
    if metadata.get("images") != "true":
        model.encoder.image = None  # a branch that has never seen an image would only disturb
    return model
