# SPDX-License-Identifier: Apache-2.0
"""bf16 on devices that multiply it in hardware."""

from __future__ import annotations

from functools import cache

import torch
from llvmlite import binding
from torch import Tensor


def mixed_precision(device: torch.device, wanted: bool = True) -> torch.autocast:
    """The context of the network on this device: autocast to bf16 if wanted and supported, else float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and multiplies_bf16(device.type))


def product_type(x: Tensor) -> torch.dtype:
    """The type of what is multiplied with a tensor: bf16 under autocast, else the tensor's own."""
    return torch.bfloat16 if torch.is_autocast_enabled(x.device.type) else x.dtype


@cache
def multiplies_bf16(kind: str) -> bool:
    """Whether this kind of device ("cpu", "cuda", ...) has instructions for products of bf16.

    A processor has AVX-512 BF16, AMX or those of ARM, a GPU those of Ampere. One without them can emulate bf16: the
    whole network then takes six times as long as in float32 (AMD Zen 3).
    """
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if kind != "cpu":
        return True
    features = binding.get_host_cpu_features()
    return any(features.get(name, False) for name in ("avx512bf16", "amx-bf16", "bf16"))
