# SPDX-License-Identifier: Apache-2.0
"""pypose on the same task as `diffslam`: registration of a known motion, with its ICP and its LM optimizer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import rounded
from dpm2_core.diffslam.icp import Cloud, register
from dpm2_core.diffslam.trajectory_loss import SlamLossSettings
from dpm2_core.geometry import se3, se3_torch

_REPETITIONS = 3


def compare_with_pypose(scan: Tensor, T_target_source: Tensor, settings: SlamLossSettings) -> dict[str, Any]:
    """Error and time of each for a scan (N, 3) registered to itself, moved by T_target_source (4, 4), from identity.

    pypose's ICP is point-to-point with all distances at once; its LM uses our matches and residuals. Neither has point
    weights, and the LM has no gradient and computes its Jacobian by autograd. All do `iterations` steps.
    """
    try:
        import pypose
    except ImportError:
        return {"skipped": "pypose is not installed: pip install 'dpm2_ros[bench]'"}
    source = se3_torch.transform(se3_torch.inverse(T_target_source), scan)
    iterations = settings.icp.solver.iterations

    @torch.no_grad()
    def ours() -> Tensor:
        return register(Cloud(source[None]), Cloud(scan[None]), torch.eye(4)[None], settings.icp)[0]

    def icp() -> Tensor:
        stepper = pypose.utils.ReduceToBason(steps=iterations, patience=iterations)
        return pypose.module.ICP(stepper=stepper)(source, scan).matrix()

    def lm() -> Tensor:
        return _register_with_lm(pypose, source, scan, iterations)

    methods: dict[str, Callable[[], Tensor]] = {"dpm2": ours, "pypose_icp": icp, "pypose_lm": lm}
    rows = {name: _measure(run, T_target_source.numpy()) for name, run in methods.items()}
    return {"version": pypose.__version__, "iterations": iterations, **rows}


def _measure(run: Callable[[], Tensor], requested: np.ndarray) -> dict[str, float]:
    seconds = []
    for _ in range(_REPETITIONS):
        begin = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - begin)
    meters, degrees = se3.apart(requested, result.detach().double().numpy())
    return {"mm": rounded(1e3 * meters), "deg": rounded(degrees), "ms": rounded(1e3 * float(np.median(seconds)))}


def _register_with_lm(pypose: Any, source: Tensor, target: Tensor, iterations: int) -> Tensor:
    """Point-to-plane with `pypose.optim.LM`: its adaptive damping (up 2, down 0.5), new matches at each step."""
    cloud = Cloud(target[None])

    class Plane(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.T = pypose.Parameter(pypose.identity_SE3(dtype=torch.float64))

        def forward(self, q: Tensor, n: Tensor) -> Tensor:
            return (n * (self.T.Act(source) - q)).sum(-1, keepdim=True)

    model = Plane()
    optimizer = pypose.optim.LM(model, strategy=pypose.optim.strategy.Adaptive(damping=1e-6))
    for _ in range(iterations):
        with torch.no_grad():
            moved = model.T.Act(source)
        index = cloud.search.nearest(moved[None])[0, :, 0]
        optimizer.step((target[index], cloud.normals[0, index]))
    return model.T.matrix()
