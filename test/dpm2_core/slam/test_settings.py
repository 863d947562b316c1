# SPDX-License-Identifier: Apache-2.0
"""Presets of the SLAM: changes to the defaults, under what is set besides."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from dpm2_core.config import dump_settings, load_settings
from dpm2_core.errors import UsageError
from dpm2_core.slam import settings
from dpm2_core.slam.settings import Config, SlamSettings

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


@pytest.mark.parametrize("name", ["papers", "../paper", "3", "[paper]"])
def test_another_name_is_an_error_that_names_the_choice(name: str) -> None:
    with pytest.raises(UsageError, match=r"--set slam\.preset=.*'highway' or 'paper'"):
        load_settings(Config, None, [f"slam.preset={name}"])
