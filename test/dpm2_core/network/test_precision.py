# SPDX-License-Identifier: Apache-2.0
"""bf16 if the processor can multiply it, otherwise float32; both give the same poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from llvmlite import binding

from dpm2_core.data.kitti import KittiSource
from dpm2_core.geometry import se3
from dpm2_core.network import precision
from dpm2_core.network.pretrained import load_network

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def forgotten() -> Any:
    """The processor's features are read once per process; forget them around each test."""
    precision.multiplies_bf16.cache_clear()
    yield
    precision.multiplies_bf16.cache_clear()


def processor(monkeypatch: pytest.MonkeyPatch, *features: str) -> None:
    monkeypatch.setattr(binding, "get_host_cpu_features", lambda: dict.fromkeys(features, True) | {"fma": True})


@pytest.mark.parametrize("features", [("avx512f", "avx512bf16"), ("amx-bf16",), ("neon", "bf16")])
def test_bf16_is_used_where_the_processor_has_it(monkeypatch: pytest.MonkeyPatch, features: tuple[str, ...]) -> None:
    """Training can still request float32."""
    processor(monkeypatch, *features)
    with precision.mixed_precision(CPU):
        assert torch.is_autocast_enabled("cpu")
    with precision.mixed_precision(CPU, wanted=False):
        assert not torch.is_autocast_enabled("cpu")


@pytest.mark.parametrize("features", [("avx2",), ("avx2", "avx512f", "avx512bw"), ("neon",)])
def test_elsewhere_float32(monkeypatch: pytest.MonkeyPatch, features: tuple[str, ...]) -> None:
    """Desktop processors, and servers from before 2020, use float32."""
    processor(monkeypatch, *features)
    with precision.mixed_precision(CPU):
        assert not torch.is_autocast_enabled("cpu")


def test_both_give_the_same_poses(monkeypatch: pytest.MonkeyPatch, recording: Path) -> None:
    """The shipped weights on frames 5 m apart, trained in bf16: maps described in one format are usable in the
    other."""
    network, frames = load_network("small", 1), list(KittiSource(recording / "sequences" / "00").frames())[:12:6]
    described, poses = {}, {}
    for name in ("avx2", "avx512bf16"):
        precision.multiplies_bf16.cache_clear()
        processor(monkeypatch, name)
        described[name] = [network.describe(frame) for frame in frames]
    for target in described:
        result = network.register(described["avx512bf16"][1], described[target][0])
        assert result.ok
        poses[target] = result.T_target_source
    difference = se3.way(poses["avx2"], poses["avx512bf16"])
    assert np.linalg.norm(difference[3:]) < 0.02  # m; similar to the error of a pose
    assert np.degrees(np.linalg.norm(difference[:3])) < 0.1
