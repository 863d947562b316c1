# SPDX-License-Identifier: Apache-2.0
"""bf16 where the processor multiplies it."""

from __future__ import annotations

from functools import cache

import torch
from llvmlite import binding


def mixed_precision(device: torch.device, wanted: bool = True) -> torch.autocast:
    """The network's context on this device: autocast to bf16 if it is wanted and as fast as float32, else float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and (device.type != "cpu" or multiplies_bf16()))


@cache
def multiplies_bf16() -> bool:
    """Whether this processor has instructions for products of bf16 (AVX-512 BF16, AMX or those of ARM).

    One that has to emulate them takes six times as long as with float32, the whole network (AVX2, AMD Zen 3).
    """
    features = binding.get_host_cpu_features()
    return any(features.get(name, False) for name in ("avx512bf16", "amx-bf16", "bf16"))
