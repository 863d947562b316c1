# SPDX-License-Identifier: Apache-2.0
"""The same drives with other settings: every combination of values on every drive, and one table of means."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from dpm2_core.errors import UsageError
from dpm2_core.fleet.drives import ManifestDrive, parts_of
from dpm2_core.fleet.part import Outcome, Part
from dpm2_core.tables import FigureTable

_COMMA = re.compile(r",(?![^\[{]*[\]}])")  # not within a list or a mapping
_MEAN_COLUMNS = {"t_err %": "t_err_percent", "APE m": "ape_rmse_m", "RPE m": "rpe_trans_m"}


def variants(settings: Sequence[str]) -> dict[str, list[str]]:
    """KEY=VALUE of each combination of KEY=VALUE,VALUE,..., by a name that a folder can have.

    Raises:
        UsageError: a key has no values, or is given twice.
    """
    keys = [_key(setting) for setting in settings]
    if duplicates := {key for key in keys if keys.count(key) > 1}:
        raise UsageError(f"--set {min(duplicates)}: given twice; give all its values at once, with commas")
    out = {}
    for values in product(*(_values(setting) for setting in settings)):
        chosen = [f"{key}={value}" for key, value in zip(keys, values, strict=True)]
        # Names are unique: each has the whole key, and % codes for characters that a folder's name cannot have.
        out[" ".join(chosen).replace("%", "%25").replace("/", "%2F")] = chosen
    return out


def _key(setting: str) -> str:
    return setting.partition("=")[0].strip()


def _values(setting: str) -> list[str]:
    _, equals, text = setting.partition("=")
    values = [value.strip() for value in _COMMA.split(text)]
    if not equals or not all(values):
        raise UsageError(f"--set {setting}: want KEY=VALUE,VALUE, such as slam.map.voxel=0.2,0.3")
    return values


def sweep_parts(
    drives: Sequence[ManifestDrive], config: Path | None, settings: Mapping[str, Sequence[str]]
) -> Iterator[Part]:
    """A part for each drive with each combination of `variants`.

    Raises:
        UsageError: an unknown setting, or one for which a drive of a list has its own value.
    """
    keys = {_key(setting) for overrides in settings.values() for setting in overrides}
    for drive in drives:
        if own := [setting for setting in drive.set if _key(setting) in keys]:
            raise UsageError(f"{drive.name}: the list has {own[0]} for it, which would override all values of --set")
    for name, overrides in settings.items():
        yield from parts_of(drives, config, overrides, f"{name}/")


def sweep_table(title: str, names: Sequence[str], outcomes: Sequence[Outcome]) -> FigureTable:
    """A row for each combination: means over the drives that are complete with all of them, the same for each row."""
    found = {outcome.name: outcome.figures for outcome in outcomes if outcome.figures is not None}
    drives = dict.fromkeys(outcome.name.partition("/")[2] for outcome in outcomes)
    complete = [drive for drive in drives if all(f"{name}/{drive}" in found for name in names)]
    caption = f"means over {len(complete)} of {len(drives)} drives: those that are complete with all settings"
    table = FigureTable(
        title, names=["settings"], figures=["failed", *_MEAN_COLUMNS, "breaks", "loops", "s"], caption=caption
    )
    for name in names:
        rows = [found[f"{name}/{drive}"] or {} for drive in complete]
        metrics = [row["metrics"] or {} for row in rows]
        means = [_mean([one.get(key) for one in metrics]) for key in _MEAN_COLUMNS.values()]
        failed = sum(f"{name}/{drive}" not in found for drive in drives)
        sums = sum(row["breaks"] for row in rows), sum(row["loops"]["accepted"] for row in rows)
        seconds = sum(row["part"]["seconds"] for row in rows)
        table.add_row(name, str(failed), *means, *map(str, sums), f"{seconds:.0f}")
    return table


def _mean(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.3f}" if known and len(known) == len(values) else "-"
