# SPDX-License-Identifier: Apache-2.0
"""What the network's benchmark reuses from the file of a previous run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import neural
from benchmarks.harness import Options
from dpm2_core.data.packed import Sample, write_packed
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.weights import save_weights

from ..helpers.networks import tiny


def _drive(folder: Path, scans: int) -> Path:
    (folder / "velodyne").mkdir(parents=True)
    for number in range(scans):
        np.full((40, 4), 2.0 + number, np.float32).tofile(folder / "velodyne" / f"{number:06d}.bin")
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    return folder


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
    """Parts measured with other options are measured again. Previously they were kept, although the record stated the
    new options: another solver seemed to make no difference, since nothing was measured."""
    measured: list[str] = []

    def part(network: DeepPointMap2, options: Options) -> dict[str, Any]:
        measured.append(str(options.overrides or options.pairs))
        return {}

    monkeypatch.setattr(neural, "PARTS", {"first": part, "second": part})
    save_weights(DeepPointMap2(tiny()), tmp_path / "tiny.safetensors", {"phase": "2"})
    weights = f"slam.neural.weights={tmp_path}/tiny.safetensors"
    options = Options(out=tmp_path, sources=[_drive(tmp_path / "00", 2)], overrides=[weights], threads=1, pairs=3)
    other = {**other, "overrides": [weights, *other.get("overrides", ())]}
    neural.bench_neural(options)
    neural.bench_neural(options)
    assert len(measured) == 2
    neural.bench_neural(replace(options, only="second", **other))
    assert len(measured) == 3
    record = json.loads((tmp_path / "neural.json").read_text())
    assert list(record["parts"]) == ["second"]  # the other one has other options
    neural.bench_neural(replace(options, **other))
    assert len(measured) == 4
    record = json.loads((tmp_path / "neural.json").read_text())
    assert list(record["parts"]) == ["first", "second"]
    assert record["options"]["threads"] == record["machine"]["threads"]


def _worlds(folder: Path, points: int) -> Path:
    write_packed(folder / "world", [Sample(np.zeros((points, 3), np.float32), np.eye(4))], {})
    return folder


def test_parts_of_other_drives_and_worlds_of_the_same_name_are_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An excerpt of 00 and the whole sequence are different drives. Previously, the table was that of the first call in
    both cases."""
    measured: list[Path] = []

    def part(network: DeepPointMap2, options: Options) -> dict[str, Any]:
        measured.append(options.sources[0])
        return {}

    monkeypatch.setattr(neural, "PARTS", {"first": part})
    save_weights(DeepPointMap2(tiny()), tmp_path / "tiny.safetensors", {"phase": "2"})
    excerpt, whole = _drive(tmp_path / "excerpt" / "00", 2), _drive(tmp_path / "whole" / "00", 3)
    val, other = _worlds(tmp_path / "one" / "val", 5), _worlds(tmp_path / "other" / "val", 6)
    options = Options(out=tmp_path, overrides=[f"slam.neural.weights={tmp_path}/tiny.safetensors"], threads=1)
    for drive, worlds in ((excerpt, val), (excerpt, val), (whole, val), (whole, other), (whole, other)):
        neural.bench_neural(replace(options, sources=[drive], unseen=worlds))
    assert measured == [excerpt, whole, whole]
