# SPDX-License-Identifier: Apache-2.0
"""Differentiable SLAM: convergence of every gate, gradients against each other and finite differences, and cost."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from rich.console import Group
from torch import Tensor

from benchmarks.diffslam_pypose import compare_with_pypose
from benchmarks.harness import Options, Report, processors, rounded, torch_threads
from dpm2_core.config import load_settings
from dpm2_core.diffslam.clouds import window
from dpm2_core.diffslam.icp import Cloud, Matching
from dpm2_core.diffslam.soft_lm import iterates
from dpm2_core.diffslam.trajectory_loss import SlamLoss, SlamLossSettings, odometry, trajectory_loss
from dpm2_core.geometry import se3, se3_torch
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.world import build_world
from dpm2_core.tables import FigureTable

SCANS, POINTS = 8, 2048
MOTION = se3.exp(np.array([0.002, -0.003, np.radians(1.2), 0.8, 0.1, 0.02]))
"""T_target_source of the known motion: 0.81 m, 1.2 deg."""
_CONVERGED_ITERATIONS = 60  # iterations, after which nothing changes
_DIFFERENCE_STEP = 1e-4  # m, of the finite difference
_RANKS = (0, 1, 10, 100, 1000)  # ranks, by gradient length, of the points that are moved for it
_NOISE = 0.01  # m, difference of a predicted scan from its target


def bench_diffslam(options: Options) -> Report:
    """Eight scans of a synthetic suburb, downsampled to 2,048 points each; overrides are of `SlamLossSettings`."""
    settings = load_settings(SlamLossSettings, None, options.overrides)
    settings = settings.model_copy(update={"points": POINTS})
    with torch_threads(options.threads), processors(options.threads):
        scans, truth = street_scans()
        points, _ = window(scans, None, POINTS, settings.voxel, "scans")
        results: dict[str, Any] = {
            "known_motion": known_motion(points[0], settings),
            "gates": gates(points, truth, settings),
            "gradients": gradients(points, settings),
            "cost": {"cpu": cost(points, settings, max(options.repetitions, 5))},
            "pypose": compare_with_pypose(points[0], torch.from_numpy(MOTION), settings),
        }
        if torch.cuda.is_available():
            device = torch.cuda.get_device_name()
            results["cost"][device] = cost(points.cuda(), settings, max(options.repetitions, 20))
    return Report(results, _view(results))


def street_scans() -> tuple[list[Tensor], Tensor]:
    """Eight scans (N, 3) of a drive, with traffic, and their exact trajectory (8, 4, 4)."""
    world, lidar = build_world("straight", "suburb", seed=8, length=100.0), Lidar()
    times = 2.0 + 0.1 * np.arange(SCANS)
    poses = np.stack([lidar.pose(world, float(t)) for t in times])
    scans = [
        lidar.scan(world, T, float(t), np.random.default_rng(i)).points[:, :3]
        for i, (T, t) in enumerate(zip(poses, times, strict=True))
    ]
    return [torch.from_numpy(scan) for scan in scans], torch.from_numpy(se3.inverse(poses[0]) @ poses)


def with_solver(settings: SlamLossSettings, **changes: Any) -> SlamLossSettings:
    """Settings with changes to the solver of the registration."""
    solver = settings.icp.solver.model_copy(update=changes)
    return settings.model_copy(update={"icp": settings.icp.model_copy(update={"solver": solver})})


def known_motion(scan: Tensor, settings: SlamLossSettings) -> dict[str, Any]:
    """Error after each iteration, mm and deg, of registering a scan (N, 3) to itself, moved, for every gate."""
    out = {}
    target = Cloud(scan[None])
    source = Cloud(se3_torch.transform(torch.from_numpy(se3.inverse(MOTION)), scan)[None])
    begin = torch.eye(4, dtype=torch.float64)[None, None]
    for gate in ("soft", "none", "gradslam", "paper"):
        icp = with_solver(settings, gate=gate).icp
        found = torch.cat([T[0] for T in iterates(Matching(source, target, icp), begin, icp.solver)]).numpy()
        error = se3.inverse(MOTION) @ found
        meters, radians = np.linalg.norm(error[:, :3, 3], axis=1), se3.angle(error)
        out[gate] = {"mm": [rounded(1e3 * x) for x in meters], "deg": [rounded(x) for x in np.degrees(radians)]}
    return out


def gates(points: Tensor, truth: Tensor, settings: SlamLossSettings) -> dict[str, Any]:
    """Independent scans (T, N, 3): distance of the trajectory and its gradient from those at convergence."""
    converged, converged_gradient = _point_gradient(
        points, truth, with_solver(settings, iterations=_CONVERGED_ITERATIONS, gate="none")
    )
    rows: dict[str, dict[str, Any]] = {}
    variants: dict[str, dict[str, Any]] = {
        "soft": {"gate": "soft"},
        "soft, lenience 0": {"gate": "soft", "lenience": 0.0},
        "none": {"gate": "none"},
        "gradslam": {"gate": "gradslam"},
        "paper": {"gate": "paper"},
    }
    for name, changes in variants.items():
        for gradient in ("unrolled", "implicit"):
            poses, g = _point_gradient(points, truth, with_solver(settings, gradient=gradient, **changes))
            rows.setdefault(name, {})[gradient] = {
                "to_converged_mm": rounded(1e3 * float((poses - converged)[1:, :3, 3].norm(dim=1).mean())),
                "gradient_cosine": rounded(
                    float((g * converged_gradient).sum() / (g.norm() * converged_gradient.norm()).clamp(min=1e-300))
                ),
            }
    steps, true_steps = (se3.inverse(T[:-1].numpy()) @ T[1:].numpy() for T in (converged, truth))
    error = se3.inverse(true_steps) @ steps
    return {
        "iterations": settings.icp.solver.iterations,
        "rpe_at_convergence": {
            "mm": rounded(1e3 * float(np.linalg.norm(error[:, :3, 3], axis=1).mean())),
            "deg": rounded(float(np.degrees(se3.angle(error)).mean())),
        },
        "rows": rows,
    }


def _point_gradient(points: Tensor, truth: Tensor, settings: SlamLossSettings) -> tuple[Tensor, Tensor]:
    """Trajectory, and the gradient of its error with respect to all points."""
    leaf = points.clone().requires_grad_()
    poses = odometry(leaf, settings=settings)
    (gradient,) = torch.autograd.grad(trajectory_loss(poses, truth), leaf)
    return poses.detach(), gradient


def gradients(points: Tensor, settings: SlamLossSettings) -> dict[str, Any]:
    """Gradients of the loss of noisy scans against clean ones: single points against finite differences; both kinds."""
    noisy = points + _NOISE * torch.randn(points.shape, generator=torch.Generator().manual_seed(0), dtype=points.dtype)
    frames = [("drive", t) for t in range(len(points))]
    out: dict[str, Any] = {"iterations": _CONVERGED_ITERATIONS, "rank_of_slope": list(_RANKS)}
    found = {}
    for gradient in ("unrolled", "implicit"):
        loss = SlamLoss(with_solver(settings, gradient=gradient, iterations=_CONVERGED_ITERATIONS))
        leaf = noisy.clone().requires_grad_()
        (point_gradients,) = torch.autograd.grad(loss(leaf, points, frames=frames), leaf)
        found[gradient] = point_gradients
        order = point_gradients.norm(dim=-1).flatten().argsort(descending=True)
        errors = []
        for index in order[list(_RANKS)].tolist():
            t, i = divmod(index, point_gradients.shape[1])
            length = float(point_gradients[t, i].norm())
            values = []
            for step in (_DIFFERENCE_STEP, -_DIFFERENCE_STEP):
                moved = noisy.clone()
                moved[t, i] += step * point_gradients[t, i] / length
                with torch.no_grad():
                    values.append(float(loss(moved, points, frames=frames)))
            errors.append(rounded(abs((values[0] - values[1]) / (2 * _DIFFERENCE_STEP) / length - 1)))
        out[gradient] = {"relative_errors": errors, "median": rounded(float(np.median(errors))), "worst": max(errors)}
    a, b = found["unrolled"], found["implicit"]
    out["implicit_against_unrolled"] = rounded(float((a - b).norm() / a.norm()))
    return out


def cost(points: Tensor, settings: SlamLossSettings, repetitions: int) -> dict[str, Any]:
    """Seconds of `SlamLoss`, forward (both branches) and backward, and the memory of the graph in between."""
    noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(0), dtype=points.dtype).to(points)
    rows = {}
    for gradient in ("unrolled", "implicit"):
        loss = SlamLoss(with_solver(settings, gradient=gradient))
        frames = [("drive", t) for t in range(len(points))]
        leaf = (points + _NOISE * noise).requires_grad_()
        row: dict[str, Any] = {}
        for name, frame_names in (("reference_anew", None), ("reference_cached", frames)):
            loss(leaf, points, frames=frame_names)  # warm-up, and fills the cache
            forward, backward = [], []
            for _ in range(repetitions):
                _synchronize(points)
                begin = time.perf_counter()
                value = loss(leaf, points, frames=frame_names)
                _synchronize(points)
                middle = time.perf_counter()
                value.backward()
                _synchronize(points)
                forward.append(middle - begin)
                backward.append(time.perf_counter() - middle)
            row[name] = {
                "forward_ms": rounded(1e3 * float(np.median(forward))),
                "backward_ms": rounded(1e3 * float(np.median(backward))),
                "both_ms": rounded(1e3 * float(np.median(np.add(forward, backward)))),
            }
        row["graph_mb"] = rounded(_graph_bytes(loss, leaf, points) / 1e6)
        rows[gradient] = row
    return {"scans": len(points), "points": points.shape[1], "repetitions": repetitions, **rows}


def _graph_bytes(loss: SlamLoss, leaf: Tensor, points: Tensor) -> int:
    """Bytes that autograd keeps for the backward pass."""
    storages: dict[int, int] = {}

    def keep(x: Tensor) -> Tensor:
        storages[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda x: x):
        value = loss(leaf, points)  # alive, so that no storage is counted twice
    total = sum(storages.values())
    del value
    return total


def _synchronize(points: Tensor) -> None:
    if points.is_cuda:
        torch.cuda.synchronize()


def _view(results: dict[str, Any]) -> Group:
    iterations = [str(i + 1) for i in range(len(results["known_motion"]["soft"]["mm"]))]
    known = FigureTable("Known motion: mm left after each iteration", names=["gate"], figures=iterations)
    for gate, row in results["known_motion"].items():
        known.add_row(gate, *(f"{x:.3g}" if x >= 1e-3 else "<0.001" for x in row["mm"]))
    title = f"Eight scans, {results['gates']['iterations']} iterations"
    figures = ["mm to converged", "cosine to its gradient"]
    rows = FigureTable(title, names=["gate", "gradient"], figures=figures)
    for gate, row in results["gates"]["rows"].items():
        for gradient, of in row.items():
            rows.add_row(gate, gradient, f"{of['to_converged_mm']:.3g}", f"{of['gradient_cosine']:.4f}")
    g = results["gradients"]
    lines = [f"implicit against unrolled: {g['implicit_against_unrolled']:.2%}"]
    lines += [
        f"{k} against finite difference: median {g[k]['median']:.2%}, worst {g[k]['worst']:.2%} of {len(_RANKS)} points"
        for k in ("unrolled", "implicit")
    ]
    for device, table in results["cost"].items():
        for k in ("unrolled", "implicit"):
            ms, held = table[k]["reference_anew"]["both_ms"], table[k]["graph_mb"]
            lines.append(f"{device}, {k}: {ms:.0f} ms a window forward and backward, {held:.0f} MB held")
    return Group(known, rows, *lines, f"pypose: {results['pypose']}")
