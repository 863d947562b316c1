# SPDX-License-Identifier: Apache-2.0
"""Every argument and option of a command of `dpm2` has an effect: its function uses it."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

import dpm2_core.commands
from dpm2_core.commands.options import show

from ...helpers.command import refused

COMMANDS = sorted(Path(dpm2_core.commands.__path__[0]).glob("*.py"))


@pytest.mark.parametrize("module", COMMANDS, ids=lambda path: path.stem)
def test_no_parameter_of_a_command_is_ignored(module: Path) -> None:
    """A parameter whose name the body never reads would be accepted but have no effect."""
    for function in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(function, ast.FunctionDef):
            read = {node.id for part in function.body for node in ast.walk(part) if isinstance(node, ast.Name)}
            arguments = {argument.arg for argument in (*function.args.args, *function.args.kwonlyargs)}
            assert arguments <= read | {"self"}, f"{module.name}: {function.name}"


def test_figures_on_stdout_are_json_where_one_is_not_known(capsys: pytest.CaptureFixture[str]) -> None:
    show("", {"moved_m": float("nan")}, Path("-"))
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == {"moved_m": None}


@pytest.mark.parametrize(("command", "words"), [
    (["run", ".", "--out", "o", "--resume"], "--resume: needs the map, --map FILE"),
    (["run", ".", "--out", "o", "--extend"], "--extend: needs the map, --map FILE"),
    (["run", ".", "--out", "o", "--localise", "m", "--extend"], "--extend: needs the map, --map FILE"),
    (["map", "export", "m", "a.g2o", "--voxel", "1"], "--voxel: does not apply to g2o"),
    (["map", "export", "m", "a.ply", "--resolution", "1"], "--resolution: does not apply to ply"),
    (["map", "merge", "a", "b", "--out", "c", "--transform", "1 2 3 4", "--set", "slam.threads=1"],
     "--config and --set are for finding places"),
])  # fmt: skip
def test_an_option_without_effect_is_rejected(
    command: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error comes before any file is opened, and no file is made."""
    monkeypatch.chdir(tmp_path)
    assert words in refused(*command)
    assert not list(tmp_path.iterdir())


def test_a_task_without_slam_loss_takes_no_weight_for_it(tmp_path: Path) -> None:
    error = refused("train", "movers", tmp_path, "--out", tmp_path / "out", "--set", "slam.gamma=1")
    assert "unknown key slam" in error
