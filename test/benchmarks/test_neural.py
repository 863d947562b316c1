# SPDX-License-Identifier: Apache-2.0
"""What the benchmark of the network takes from the file of a run before."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks import neural
from benchmarks.harness import Options
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.weights import save_weights

from ..helpers.networks import tiny


@pytest.mark.parametrize(
    "other",
    [
        {"overrides": ("slam.neural.solver=confident",)},
        {"pairs": 7},
        {"threads": 2},
        {"repetitions": 2},
        {"sources": (Path("drive"),)},
        {"unseen": Path("worlds")},
    ],
    ids=lambda other: next(iter(other)),
)
def test_parts_of_other_options_are_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: dict[str, Any]
) -> None:
    """They were kept, and the record said that they were measured with the options of this call: another solver made
    no difference, as nothing was measured."""
    measured: list[str] = []

    def part(network: DeepPointMap2, options: Options) -> dict[str, Any]:
        measured.append(str(options.overrides or options.pairs))
        return {}

    monkeypatch.setattr(neural, "PARTS", {"first": part, "second": part})
    save_weights(DeepPointMap2(tiny()), tmp_path / "tiny.safetensors", {"phase": "2"})
    weights = f"slam.neural.weights={tmp_path}/tiny.safetensors"
    options = Options(out=tmp_path, overrides=[weights], threads=1, pairs=3)
    other = {**other, "overrides": [weights, *other.get("overrides", ())]}
    neural.bench_neural(options)
    neural.bench_neural(options)
    assert len(measured) == 2
    neural.bench_neural(replace(options, only="second", **other))
    assert len(measured) == 3
    record = json.loads((tmp_path / "neural.json").read_text())
    assert list(record["parts"]) == ["second"]  # the other one is of other options
    neural.bench_neural(replace(options, **other))
    assert len(measured) == 4
    record = json.loads((tmp_path / "neural.json").read_text())
    assert list(record["parts"]) == ["first", "second"]
    assert record["options"]["threads"] == record["machine"]["threads"]
