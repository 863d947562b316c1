# SPDX-License-Identifier: Apache-2.0
"""Weights: saving and loading, and everything that must not be loaded."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from dpm2_core.descriptors import Descriptors
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.weights import (
    load_fitting,
    load_model,
    load_weights,
    read_tensors,
    save_weights,
)

from ...helpers.networks import tiny


@pytest.fixture
def saved(model: DeepPointMap2, tmp_path: Path) -> Path:
    """Weights of the tiny network."""
    save_weights(model, tmp_path / "tiny.safetensors", {"steps": "3"})
    return tmp_path / "tiny.safetensors"


def test_round_trip(model: DeepPointMap2, saved: Path) -> None:
    """A file describes its network and contains every tensor, to fp16."""
    loaded = load_model(saved)
    assert loaded.settings == model.settings
    for name, value in model.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value, atol=1e-3, rtol=1e-3)
    assert load_weights(model, saved)["steps"] == "3"


@pytest.mark.parametrize(("value", "half"), [(float("nan"), False), (1e6, True)])
def test_weights_that_could_not_be_loaded_are_not_written(
    model: DeepPointMap2, tmp_path: Path, value: float, half: bool
) -> None:
    """Values that are not finite, or too large for fp16, are an error. Previously, a training that diverged wrote
    weights that every command rejected."""
    torch.nn.init.constant_(next(model.parameters()), value)
    with pytest.raises(Dpm2Error, match=r"not written: .* holds values that are not finite"):
        save_weights(model, tmp_path / "new.safetensors", {}, half)
    assert not (tmp_path / "new.safetensors").exists()


def test_the_same_weights_are_the_same_file(model: DeepPointMap2, tmp_path: Path) -> None:
    """Equal weights and metadata give equal files. Previously, the metadata was written in any order, so that equal
    trainings counted as other weights for a map."""
    path = tmp_path / "equal.safetensors"
    about = {key: f"{key} \u00e4\n" for key in "abcdefgh"}
    files = set()
    for keys in (about, reversed(about)):  # 10! orders: a test without sorting cannot pass by chance
        save_weights(model, path, {key: about[key] for key in keys})
        files.add(path.read_bytes())
    assert len(files) == 1
    assert about.items() <= read_tensors(path)[1].items()
    load_weights(model, path)


def test_overlap_is_checked_after_overlap_alone(model: DeepPointMap2, saved: Path, tmp_path: Path) -> None:
    """An untrained head returns NaN, never a figure that would pass a gate."""
    noise = np.random.default_rng(0)
    descriptors = Descriptors.of(noise.uniform(-9, 9, (40, 3)).astype(np.float32), noise.normal(size=(40, 32)))
    save_weights(model, tmp_path / "two.safetensors", {"phase": "2"})
    untrained, trained = (
        load_model(path).register_many([descriptors], [descriptors])[0].overlap
        for path in (saved, tmp_path / "two.safetensors")
    )
    assert np.isnan(untrained)
    assert 0 < trained < 1


def test_wrong_preset_is_rejected(saved: Path) -> None:
    """The error names both."""
    other = DeepPointMap2(tiny().model_copy(update={"preset": "huge"}))
    with pytest.raises(UsageError, match="weights of preset tiny, but the network is of preset huge"):
        load_weights(other, saved)


def test_wrong_shape_under_the_right_name_is_rejected(saved: Path) -> None:
    """This includes a missing layer; nothing is loaded then."""
    other = DeepPointMap2(tiny(decoder={"layers": 2}))
    before = {name: value.clone() for name, value in other.state_dict().items()}
    with pytest.raises(UsageError, match=r"does not fit preset tiny: \d+ tensors differ, such as decoder"):
        load_weights(other, saved)
    assert all(torch.equal(before[name], value) for name, value in other.state_dict().items())


class _Bomb:
    def __reduce__(self) -> tuple[Callable, tuple[str]]:
        return (Path.touch, (Path("exploded"),))  # type: ignore[return-value]


def test_a_pickle_is_rejected_and_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both a bare pickle and one in torch's format are rejected."""
    monkeypatch.chdir(tmp_path)
    Path("bare.safetensors").write_bytes(pickle.dumps(_Bomb()))
    torch.save({"x": _Bomb()}, "torch.safetensors")
    for name in ("bare.safetensors", "torch.safetensors"):
        with pytest.raises(UsageError, match="not a safetensors file"):
            load_model(Path(name))
    assert not Path("exploded").exists()


def test_missing_truncated_and_foreign_files(saved: Path, tmp_path: Path) -> None:
    """Each error is one line with the path."""
    with pytest.raises(UsageError, match="no such weights"):
        load_model(tmp_path / "none.safetensors")
    saved.write_bytes(saved.read_bytes()[:1000])
    with pytest.raises(UsageError, match="not a safetensors file"):
        load_model(saved)
    save_file({"x": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(UsageError, match="without a network description"):
        load_model(tmp_path / "foreign.safetensors")
    save_file(
        {"head.bias": torch.zeros(1)}, tmp_path / "task.safetensors", {"task": "gndnet", "network": '{"cell": 1}'}
    )
    with pytest.raises(UsageError, match="weights of the task 'gndnet', not of the network"):
        load_model(tmp_path / "task.safetensors")


def test_weights_that_fit_in_part(tmp_path: Path) -> None:
    """Tensors of the same name and shape are loaded, the rest is kept and named; if nothing fits, that is an error."""
    torch.manual_seed(0)
    path = tmp_path / "a.safetensors"
    save_weights(DeepPointMap2(tiny()), path, {}, half=False)
    other = DeepPointMap2(tiny(fusion={"kind": "point_painting", "reference_features": False}))
    before = {name: value.clone() for name, value in other.state_dict().items()}
    random = load_fitting(other, path)
    assert {"encoder.points.patch.paint.weight", "encoder.fusion.references.embed.0.weight"} <= set(random)
    stored = load_file(path)
    for name, value in other.state_dict().items():
        assert torch.equal(value, before[name] if name in random else stored[name]), name
    save_file({"nothing": torch.zeros(1)}, tmp_path / "b.safetensors")
    with pytest.raises(UsageError, match="none of its tensors fits"):
        load_fitting(other, tmp_path / "b.safetensors")
