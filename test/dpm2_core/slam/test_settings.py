# SPDX-License-Identifier: Apache-2.0
"""Presets of the SLAM change the defaults, and explicit settings override them. Also: which numbers are allowed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from dpm2_core.config import dump_settings, flat_fields, load_settings
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Frame
from dpm2_core.slam import settings
from dpm2_core.slam.build import make_odometry, make_slam
from dpm2_core.slam.preprocess import PreprocessSettings
from dpm2_core.slam.settings import Config, SlamSettings

NUMBERS = [n for n, info in flat_fields(Config) if n.startswith("slam.") and info.annotation in (int, float)]
PAPER = yaml.safe_load((Path(settings.__file__).parent / "presets" / "paper.yaml").read_text())


def test_a_preset_changes_what_it_names_and_nothing_else() -> None:
    changed = SlamSettings(preset="paper").model_dump()
    default = SlamSettings().model_dump()
    for key, value in PAPER.items():
        if isinstance(value, dict):
            assert {name: changed[key][name] for name in value} == value
            changed[key] |= {name: default[key][name] for name in value}
        else:
            assert changed[key] == value
            changed[key] = default[key]
    assert changed == default | {"preset": "paper"}


def test_what_is_set_besides_has_precedence_wherever_it_is_set(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("slam: {keyframes: {distance: 7}, preset: paper}")
    config = load_settings(Config, file, ["slam.neural.frames=3"])
    assert (config.slam.keyframes.distance, config.slam.neural.frames) == (7, 3)
    assert (config.slam.keyframes.residual, config.slam.neural.solver) == (2.5, "confident")


def test_what_is_dumped_loads_back_equal(tmp_path: Path) -> None:
    config = load_settings(Config, None, ["slam.preset=paper", "slam.loops.candidates=5"])
    (tmp_path / "config.yaml").write_text(dump_settings(config))
    assert load_settings(Config, tmp_path / "config.yaml") == config


@pytest.mark.parametrize(("first", "then"), [("indoor", "outdoor"), ("auto", "indoor"), ("highway", "paper")])
def test_a_preset_replaces_that_of_a_file_with_every_value(tmp_path: Path, first: str, then: str) -> None:
    """Other settings of the file stay, and single values have precedence over both presets."""
    file = tmp_path / "config.yaml"
    of_file = [f"slam.preset={first}", "slam.odometry.pause=0.9", "input.period=0.2"]
    file.write_text(dump_settings(load_settings(Config, None, of_file)))
    over = [f"slam.preset={then}", "slam.keyframes.distance=5.0"]
    assert load_settings(Config, file, over) == load_settings(Config, None, [*of_file, *over])


def test_a_part_that_is_given_as_settings_keeps_the_rest_of_the_preset() -> None:
    part = PreprocessSettings(deskew=False)
    assert SlamSettings(preset="indoor", preprocess=part) == SlamSettings.model_validate(
        {"preset": "indoor", "preprocess": {"deskew": False}}
    )


@pytest.mark.parametrize("name", ["papers", "../paper", "3", "[paper]"])
def test_another_name_is_an_error_that_names_the_choice(name: str) -> None:
    with pytest.raises(UsageError, match=r"--set slam\.preset=.*'highway' or 'paper'"):
        load_settings(Config, None, [f"slam.preset={name}"])


def test_no_number_of_the_slam_may_be_negative() -> None:
    for name in NUMBERS:
        with pytest.raises(UsageError, match=rf"--set {name}=-1: {name.rpartition('.')[0]}"):
            load_settings(Config, None, [f"{name}=-1"])


def _least(name: str) -> float:
    """Smallest of 0, 0.01, 1 and 3 that the setting allows."""
    for value in (0, 0.01, 1, 3):
        try:
            load_settings(Config, None, [f"{name}={value}"])
        except UsageError:
            continue
        return value
    raise AssertionError(f"{name}: nothing small is allowed")


@pytest.mark.parametrize("part", ["geometric", "local_map", "odometry", "keyframes", "map"])
def test_the_least_that_is_allowed_runs(suburb_drive: tuple[list[Frame], Array], part: str) -> None:
    """Previously, a zero ended in a traceback, sometimes only after the whole drive."""
    overrides = [f"{name}={_least(name)}" for name in NUMBERS if name.startswith(f"slam.{part}.")]
    config = load_settings(Config, None, ["slam.registration=geometric", "slam.loops.descriptors=false", *overrides])
    slam = make_slam(config.slam)
    results = [slam.process(frame) for frame in suburb_drive[0][:4]]
    slam.finish()
    assert all(np.isfinite(result.T_map_lidar).all() for result in results)
    slam.mapper.cloud()


def test_a_config_in_the_place_of_its_slam_is_an_error_of_use() -> None:
    """Previously, it ended with an AttributeError inside dpm2."""
    for make in (make_slam, make_odometry):
        with pytest.raises(UsageError, match="want SlamSettings, which a Config has as its slam, not Config"):
            make(Config())  # type: ignore[arg-type]
