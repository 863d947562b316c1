# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning on drives with another LiDAR: errors on unseen worlds of it and of the old one, before and after."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from statistics import mean, pstdev
from time import process_time
from typing import Any

import numpy as np
import torch
from rich.console import Group

from benchmarks.harness import Options, Report, write_report
from dpm2_core.config import load_settings
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.pair_set import NEAR, SUCCESS, PairSet
from dpm2_core.evaluation.record import git_commit
from dpm2_core.learning.finetune import finetune
from dpm2_core.learning.finetune_data import prepare
from dpm2_core.learning.finetune_settings import FinetuneSettings
from dpm2_core.learning.generate import GenerateSettings, generate
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.weights import load_model
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import LidarConfig, PresetName
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import FigureTable

LIDAR = LidarConfig(beams=32, height=3.4, columns=1810)
"""32 beams from +10.7 to -30.7 deg on the roof of a bus; the weights know 64 from +2 to -24.8 deg, at 1.5 to 2 m."""
DRIVES: tuple[PresetName, ...] = ("city", "suburb", "rural")
"""One of each is fine-tuned on: 12 s long, seeds from 950,000."""
DRIVE_FRAMES = 120
_TOWNS: dict[PresetName, float] = {"city": 0.35, "suburb": 0.35, "rural": 0.3}
STEPS = "optimiser.steps=120"
"""Two fifths of what `dpm2 finetune` takes by default: five trainings are to fit into twenty minutes of a processor."""
UNSEEN = {
    "new": GenerateSettings(
        worlds=8, first_seed=960_000, frames=16, beams=LIDAR.beams, height=LIDAR.height, mixture=_TOWNS
    ),
    "old": GenerateSettings(worlds=8, first_seed=970_000, frames=16, mixture=_TOWNS),
}
"""Worlds to be judged on, of the new LiDAR and of the old one."""
VARIANTS: dict[str, tuple[str, ...]] = {
    "trajectory": (),
    "pairs": ("trajectory=0", "pairs=1"),
    "both": ("pairs=1",),
    "poses": ("trajectory=0", "pairs=1", "loss.pose=10"),
}
"""Losses: that of the trajectory, as `dpm2 finetune` has it, for every seed; with the pairs for the first, alone, and
with the error of their poses."""


def bench_finetune(options: Options) -> Report:
    """Repetitions are seeds, overrides are of the fine-tuning; a training that is in finetune.json is not repeated.

    `--only` names one of the arms.
    """
    if options.only is not None and options.only not in VARIANTS:
        raise UsageError(f"--only {options.only}: no such training; choose from {', '.join(VARIANTS)}")
    path, folder = options.out / "finetune.json", options.cache / "finetune"
    threads = torch.get_num_threads()
    torch.set_num_threads(options.threads)
    try:
        chosen = load_settings(FinetuneSettings, None, [STEPS, *options.overrides])
        weights = weights_path(chosen.weights)
        network, digest = load_model(weights), hashlib.sha256(weights.read_bytes()).hexdigest()
        _prepare(folder, chosen, options)
        judges = {name: PairSet(folder / name, 2 * options.pairs, network.settings, False) for name in UNSEEN}
        results = _read(path, chosen, digest)
        results.setdefault("before", {name: errors(judge, network) for name, judge in judges.items()})
        for variant, seed in _wanted(options):
            runs = results.setdefault("runs", {}).setdefault(variant, {})
            if str(seed) in runs:
                continue
            out = (
                folder / f"{variant}_{seed}_{digest[:8]}"
            )  # a training that was stopped goes on from its own weights alone
            runs[str(seed)] = _run(variant, seed, folder / "data", out, options, judges, results["before"])
            write_report(path, "finetune", _report(results, chosen, digest), options)
    finally:
        torch.set_num_threads(threads)
    return _report(results, chosen, digest)


def _wanted(options: Options) -> list[tuple[str, int]]:
    first = [(variant, 0) for variant in VARIANTS]
    rest = [("trajectory", seed) for seed in range(1, options.repetitions)]
    return [(variant, seed) for variant, seed in first + rest if options.only in (None, variant)]


def _prepare(folder: Path, settings: FinetuneSettings, options: Options) -> None:
    """Drives, their references, the rehearsal and the unseen worlds; what is there stays."""
    sources = []
    for k, preset in enumerate(DRIVES):
        at = folder / "recorded" / preset
        simulate(at, DRIVE_FRAMES, 950_000 + k, "random", preset, images=False, lidar=LIDAR, workers=options.threads)
        sources.append(open_source(at, InputSettings(images=False)))
    network = load_model(weights_path(settings.weights)).settings
    prepare(sources, settings, network, SlamSettings(threads=options.threads), folder / "data")
    for name, worlds in UNSEEN.items():
        generate(folder / name, worlds.model_copy(update={"preset": network.preset}), options.threads)


def _run(
    variant: str, seed: int, data: Path, out: Path, options: Options, judges: dict[str, PairSet], before: dict[str, Any]
) -> dict[str, Any]:
    """One training, what it cost, and the errors that are left."""
    overrides = [STEPS, *options.overrides, *VARIANTS[variant], f"optimiser.seed={seed}"]
    settings = load_settings(FinetuneSettings, None, overrides)
    out.mkdir(parents=True, exist_ok=True)
    cpu = process_time()
    weights = finetune(settings, out, resume=(out / "checkpoint.pt").is_file(), data=data)
    seconds = process_time() - cpu
    model = load_model(weights)
    after = {name: errors(judge, model) for name, judge in judges.items()}
    ratio = {
        name: {figure: after[name][figure] / before[name][figure] for figure in ("near_m", "far_m", "all_m", "all_deg")}
        for name in judges
    }
    steps = settings.optimiser.steps
    return {"after": after, "ratio": ratio, "steps": steps, "cpu_seconds": seconds, "commit": git_commit()}


def errors(judge: PairSet, model: Any) -> dict[str, float]:
    """Medians of the errors of translation, m, and rotation, deg, and the fraction that succeeds."""
    rows = judge.errors(model)
    near = rows[:, 0] <= NEAR
    good = (rows[:, 2] < SUCCESS[0]) & (rows[:, 3] < SUCCESS[1])
    return {
        "pairs": len(rows),
        "near_m": float(np.median(rows[near, 2])),
        "far_m": float(np.median(rows[~near, 2])),
        "all_m": float(np.median(rows[:, 2])),
        "all_deg": float(np.median(rows[:, 3])),
        "success": float(good.mean()),
    }


def _read(path: Path, settings: FinetuneSettings, digest: str) -> dict[str, Any]:
    """What an earlier run of the same settings and weights has found."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        same = record["settings"] == settings.model_dump(mode="json") and record["weights_sha256"] == digest
        return {key: record[key] for key in ("before", "runs")} if same else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _report(results: dict[str, Any], settings: FinetuneSettings, digest: str) -> Report:
    before, runs = results["before"], results.get("runs", {})
    summary: dict[str, Any] = {}
    for variant, seeds in runs.items():
        summary[variant] = {
            name: {
                figure: {"mean": mean(values), "spread": pstdev(values), "seeds": len(values)}
                for figure in ("near_m", "far_m", "all_m", "all_deg")
                if (values := [run["ratio"][name][figure] for run in seeds.values()])
            }
            for name in UNSEEN
        }
    figures = ("up to 5 m", "5 to 20 m", "all", "deg", "success")
    title = "Median errors of pairs in unseen worlds, m"
    table = FigureTable(title, names=["losses", "seed", "LiDAR"], figures=figures)
    lines = [("before", "", before)]
    lines += [(variant, seed, run["after"]) for variant, seeds in runs.items() for seed, run in seeds.items()]
    for variant, seed, measured in lines:
        for name, row in measured.items():
            cells = [f"{row[figure]:.4f}" for figure in ("near_m", "far_m", "all_m", "all_deg")]
            table.add_row(variant, seed, name, *cells, f"{row['success']:.1%}")
    record = {
        "lidar": LIDAR.model_dump(), "drives": {"presets": DRIVES, "frames": DRIVE_FRAMES},
        "settings": settings.model_dump(mode="json"), "weights_sha256": digest,
        "ratios": summary, "before": before, "runs": runs,
    }  # fmt: skip
    return Report(record, Group(table))
