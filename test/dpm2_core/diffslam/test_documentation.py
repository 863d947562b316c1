# SPDX-License-Identifier: Apache-2.0
"""The example of docs/diffslam.md runs as it is written, and trains."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from torch import Tensor

PAGE = Path(__file__).resolve().parents[3] / "docs" / "diffslam.md"


class Denoiser(torch.nn.Module):
    """A user's model: a small network predicts the displacement of each point."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.Tanh(), torch.nn.Linear(16, 3))

    def forward(self, points: Tensor) -> Tensor:
        return points + 0.1 * self.layers(points / 20)


@pytest.mark.slow
def test_the_example_runs_and_the_slam_loss_takes_part(scans: list[Tensor]) -> None:
    """Twenty lines, two sequences of five scans, six epochs, the fifth with the SLAM loss; all weights change."""
    example = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    assert example is not None
    code = example[1]
    assert len([line for line in code.splitlines() if line.strip()]) <= 20
    torch.manual_seed(0)
    model = Denoiser()
    clean = [scan.float() for scan in [*scans, scans[-1]]] * 2
    data = [(scan + 0.02 * torch.randn_like(scan), scan) for scan in clean]
    before = [p.detach().clone() for p in model.parameters()]
    names = {"model": model, "optimizer": torch.optim.Adam(model.parameters(), 1e-3), "scans": data}
    scope = names | {"lengths": [5, 5], "epochs": 6}
    calls = []
    counted = code.replace("slam_loss = SlamLoss()", "slam_loss = SlamLoss()\nslam_loss.register_forward_hook(counter)")
    scope["counter"] = lambda *arguments: calls.append(float(arguments[-1].detach()))
    exec(compile(counted, str(PAGE), "exec"), scope)
    assert len(calls) == 2  # both windows of epoch 4
    assert min(calls) > 0
    assert all(
        bool(p.isfinite().all()) and not torch.equal(p, b) for p, b in zip(model.parameters(), before, strict=True)
    )
