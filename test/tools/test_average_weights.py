# SPDX-License-Identifier: Apache-2.0
"""The mean of several weights: of what all have in the same shape; the rest, and the settings, are the last one's."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from dpm2_core.errors import UsageError
from tools.average_weights import average, main


def written(path: Path, head: int, value: float) -> Path:
    tensors = {
        "layer": torch.full((2, 3), value), "head": torch.full((head,), value), "steps": torch.tensor(int(value)),
    }  # fmt: skip
    save_file(tensors, path, {"network": f"of {value}"})
    return path


def test_what_all_have_is_averaged_and_the_last_decides_the_rest(tmp_path: Path) -> None:
    files = [written(tmp_path / f"{i}.safetensors", 4 if i else 5, value) for i, value in enumerate((1.0, 2.0, 6.0))]
    tensors, about = average(files)
    torch.testing.assert_close(tensors["layer"], torch.full((2, 3), 3.0))
    torch.testing.assert_close(tensors["head"], torch.full((4,), 6.0))
    assert tensors["steps"] == 6
    assert about == {"network": "of 6.0"}
    main([str(tmp_path / "new" / "mean.safetensors"), *map(str, files)])
    again, _ = average([tmp_path / "new" / "mean.safetensors"])
    assert all(torch.equal(again[name], tensor) for name, tensor in tensors.items())


def test_what_cannot_be_averaged_is_named(tmp_path: Path) -> None:
    (tmp_path / "text.safetensors").write_text("no weights")
    for files in ([tmp_path / "missing.safetensors"], [tmp_path / "text.safetensors"]):
        with pytest.raises(UsageError, match=files[0].name):
            average(files)
    with pytest.raises(UsageError, match="want OUT IN"):
        main([str(tmp_path / "out")])
