# SPDX-License-Identifier: Apache-2.0
"""The mean of several weights: tensors that fit in all files; others are the last file's; settings are the preset's."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dpm2_core.commands.options import run_command
from dpm2_core.errors import UsageError
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.settings import preset
from dpm2_core.network.weights import load_model, read_metadata, save_weights
from tools.average_weights import average_weights


def test_the_mean_is_a_network_of_the_preset(tmp_path: Path) -> None:
    files, networks = [], []
    for steps, edges in ((10, 0.5), (20, 0.65)):
        torch.manual_seed(steps)
        networks.append(DeepPointMap2(preset("small", {"fusion": {"edges": edges}})))
        files.append(tmp_path / f"{steps}.safetensors")
        save_weights(networks[-1], files[-1], {"phase": "1", "steps": str(steps)})
    average_weights(tmp_path / "new" / "mean.safetensors", files)
    mean = load_model(tmp_path / "new" / "mean.safetensors")
    assert mean.settings == preset("small")
    assert read_metadata(tmp_path / "new" / "mean.safetensors")["steps"] == "20"
    one, other = (network.state_dict() for network in networks)
    for name, tensor in mean.state_dict().items():
        torch.testing.assert_close(tensor, (one[name] + other[name]) / 2, rtol=2e-3, atol=1e-3)  # stored in fp16


def test_a_decoder_goes_with_the_encoder_of_another_stage(tmp_path: Path) -> None:
    files = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        files.append(tmp_path / f"{seed}.safetensors")
        save_weights(DeepPointMap2(preset("small")), files[-1], {"phase": "1"})
    average_weights(tmp_path / "both.safetensors", files[:1], encoder=files[1])
    both, *stages = (load_model(path).state_dict() for path in (tmp_path / "both.safetensors", *files))
    for name, tensor in both.items():
        assert torch.equal(tensor, stages[name.startswith("encoder.")][name]), name


def test_what_cannot_be_averaged_is_named(tmp_path: Path) -> None:
    (tmp_path / "text.safetensors").write_text("no weights")
    for file in (tmp_path / "missing.safetensors", tmp_path / "text.safetensors"):
        with pytest.raises(UsageError, match=file.name):
            average_weights(tmp_path / "out", [file])


def test_what_is_averaged_must_be_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """As a program, it ends with exit code 2 and names what is missing."""
    for arguments, missing in (([], "out"), (["mean.safetensors"], "IN")):
        monkeypatch.setattr("sys.argv", ["average_weights", *arguments])
        assert run_command(average_weights) == 2
        assert missing.lower() in capsys.readouterr().err.lower()  # versions of typer differ in the case
