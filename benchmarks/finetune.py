# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning on drives with another LiDAR: errors on unseen worlds with it and with the old one, before and after."""

from __future__ import annotations

from pathlib import Path
from statistics import mean, pstdev
from time import process_time
from typing import Any

import numpy as np

from benchmarks.harness import Options, Report, earlier, requested, torch_threads, write_report
from dpm2_core.config import load_settings
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.evaluation.pair_set import NEAR, SUCCESS, PairSet
from dpm2_core.evaluation.record import git_commit
from dpm2_core.files import file_digest
from dpm2_core.learning.begun import begin_training
from dpm2_core.learning.finetune import finetune
from dpm2_core.learning.finetune_data import prepare
from dpm2_core.learning.finetune_settings import FinetuneSettings
from dpm2_core.learning.generate import GenerateSettings, generate
from dpm2_core.network.pretrained import weights_path
from dpm2_core.network.weights import load_model
from dpm2_core.sim.drive import simulate
from dpm2_core.sim.settings import DriveConfig, LidarConfig, PresetName
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.tables import record_table

LIDAR = LidarConfig(beams=32, height=3.4, columns=1810)
"""32 beams from +10.7 to -30.7 deg on the roof of a bus; the weights are for 64 from +2 to -24.8 deg, at 1.5 to 2 m."""
DRIVES: tuple[PresetName, ...] = ("city", "suburb", "rural")
"""One drive of each is used for fine-tuning: 12 s long, seeds from 950,000."""
DRIVE_FRAMES = 120
_TOWNS: dict[PresetName, float] = {"city": 0.35, "suburb": 0.35, "rural": 0.3}
STEPS = "optimiser.steps=120"
"""Two fifths of the default of `dpm2 finetune`: five trainings must fit into twenty minutes of one processor."""
UNSEEN = {
    "new": GenerateSettings(
        worlds=8, first_seed=960_000, frames=16, beams=LIDAR.beams, height=LIDAR.height, mixture=_TOWNS
    ),
    "old": GenerateSettings(worlds=8, first_seed=970_000, frames=16, mixture=_TOWNS),
}
"""Worlds for evaluation, with the new LiDAR and the old one."""
VARIANTS: dict[str, tuple[str, ...]] = {
    "trajectory": (),
    "pairs": ("trajectory=0", "pairs=1"),
    "both": ("pairs=1",),
    "poses": ("trajectory=0", "pairs=1", "loss.pose=10"),
}
"""Losses: the trajectory loss, default of `dpm2 finetune`, for every seed; with the first seed also that loss and the
pair loss, the pair loss alone, and the pair loss with the error of the poses."""
_MEDIANS = ("near_m", "far_m", "all_m", "all_deg")


def bench_finetune(options: Options) -> Report:
    """Repetitions are seeds, overrides are of the fine-tuning; a training that is in finetune.json is not repeated.

    `--only` names one of the variants.
    """
    requested_trainings = trainings(options)
    path, folder = options.out / "finetune.json", options.cache / "finetune"
    with torch_threads(options.threads):
        base_settings = load_settings(FinetuneSettings, None, [STEPS, *options.overrides])
        weights = weights_path(base_settings.weights)
        network, digest = load_model(weights), file_digest(weights)
        _prepare(folder, base_settings, options)
        validations = {name: PairSet(folder / name, 2 * options.pairs, network.settings, False) for name in UNSEEN}
        same = {"settings": base_settings.model_dump(mode="json"), "weights_sha256": digest, "pairs": options.pairs}
        before = earlier(path, "before", **same)
        before = before or {name: errors(pairs, network) for name, pairs in validations.items()}
        runs = earlier(path, "runs", **same)
        for variant, seed in requested_trainings:
            variant_runs = runs.setdefault(variant, {})
            if str(seed) in variant_runs:
                continue
            overrides = [STEPS, *options.overrides, *VARIANTS[variant], f"optimiser.seed={seed}"]
            settings = load_settings(FinetuneSettings, None, overrides)
            out = folder / f"{variant}_{seed}_{digest[:8]}"
            run = _run(settings, folder / "data", out, validations)
            variant_runs[str(seed)] = {**run, "ratio": _ratio(run["after"], before)}
            write_report(path, report(same, before, runs), options)
    return report(same, before, runs)


def trainings(options: Options) -> list[tuple[str, int]]:
    """(variant, seed): the first seed of every variant, then the other seeds of the trajectory variant."""
    variants = requested(options, VARIANTS)
    rest = range(1, options.repetitions) if "trajectory" in variants else ()
    return [*((variant, 0) for variant in variants), *(("trajectory", seed) for seed in rest)]


def _prepare(folder: Path, settings: FinetuneSettings, options: Options) -> None:
    """Create drives, their references, the rehearsal and the unseen worlds; existing ones are kept."""
    sources = []
    for k, preset in enumerate(DRIVES):
        drive_folder = folder / "recorded" / preset
        simulate(
            drive_folder,
            DriveConfig(frames=DRIVE_FRAMES, seed=950_000 + k, road="random", preset=preset, images=False, lidar=LIDAR),
            workers=options.threads,
        )
        sources.append(open_source(drive_folder, InputSettings(images=False)))
    network = load_model(weights_path(settings.weights)).settings
    prepare(sources, settings, network, SlamSettings(threads=options.threads), folder / "data")
    for name, worlds in UNSEEN.items():
        generate(folder / name, worlds.model_copy(update={"preset": network.preset}), options.threads)


def _run(settings: FinetuneSettings, data: Path, out: Path, validations: dict[str, PairSet]) -> dict[str, Any]:
    """One training, its cost, and the errors after it; an interrupted one continues with the same settings."""
    begin_training(out, settings, [weights_path(settings.weights)])
    cpu = process_time()
    weights = finetune(settings, out, data=data)
    seconds = process_time() - cpu
    model = load_model(weights)
    after = {name: errors(pairs, model) for name, pairs in validations.items()}
    return {"after": after, "steps": settings.optimiser.steps, "cpu_seconds": seconds, "commit": git_commit()}


def _ratio(after: dict[str, Any], before: dict[str, Any]) -> dict[str, dict[str, float]]:
    return {name: {figure: row[figure] / before[name][figure] for figure in _MEDIANS} for name, row in after.items()}


def errors(pairs: PairSet, model: Any) -> dict[str, float]:
    """Median errors of translation, m, and rotation, deg, and the success rate."""
    rows = pairs.errors(model)
    near = rows[:, 0] <= NEAR
    succeeded = (rows[:, 2] < SUCCESS[0]) & (rows[:, 3] < SUCCESS[1])
    return {
        "pairs": len(rows),
        "near_m": float(np.median(rows[near, 2])),
        "far_m": float(np.median(rows[~near, 2])),
        "all_m": float(np.median(rows[:, 2])),
        "all_deg": float(np.median(rows[:, 3])),
        "success": float(succeeded.mean()),
    }


def report(same: dict[str, Any], before: dict[str, Any], runs: dict[str, Any]) -> Report:
    """Errors before and after every training, which have `same` in common, and the ratios of each variant."""
    summary: dict[str, Any] = {}
    for variant, seeds in runs.items():
        summary[variant] = {
            name: {
                figure: {"mean": mean(values), "spread": pstdev(values), "seeds": len(values)}
                for figure in _MEDIANS
                if (values := [run["ratio"][name][figure] for run in seeds.values()])
            }
            for name in UNSEEN
        }
    columns = dict(zip(("up to 5 m", "5 to 20 m", "all", "deg"), (f"{{{name}:.4f}}" for name in _MEDIANS), strict=True))
    rows = {"before": {"": before}}
    rows |= {variant: {seed: run["after"] for seed, run in seeds.items()} for variant, seeds in runs.items()}
    table = record_table("Median errors of pairs in unseen worlds, m", ["losses", "seed", "LiDAR"],
                         columns | {"success": "{success:.1%}"}, rows)  # fmt: skip
    record = {
        "lidar": LIDAR.model_dump(), "drives": {"presets": DRIVES, "frames": DRIVE_FRAMES}, **same,
        "ratios": summary, "before": before, "runs": runs,
    }  # fmt: skip
    return Report(record, table)
