# SPDX-License-Identifier: Apache-2.0
"""Behavior in a terminal: help, widths, --quiet, --json, NO_COLOR, completion, Ctrl-C."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

from dpm2_core.cli import COMMANDS, GROUPS, load_command
from dpm2_core.console import QUIET, Console, progress_bar, tracked
from dpm2_core.data.trajectory import write_kitti
from dpm2_core.errors import exit_code
from dpm2_core.geometry import se3

from ..helpers.command import dpm2, dpm2_process, refused, started, succeeded

ROOT = Path(__file__).resolve().parents[2]


def all_commands() -> Iterator[tuple[str, TyperCommand]]:
    """Every command and subcommand, by its words."""
    for name in COMMANDS:
        command = load_command(name)
        if isinstance(command, TyperGroup):
            yield from ((f"{name} {sub}", single) for sub, single in command.commands.items())  # type: ignore[misc]
        else:
            yield name, command


@pytest.fixture
def straight(tmp_path: Path) -> Path:
    """A trajectory of 130 m."""
    poses = np.array([se3.make(np.eye(3), [0, 0, 1.3 * i]) for i in range(101)])
    write_kitti(tmp_path / "poses.txt", poses)
    return tmp_path / "poses.txt"


@pytest.mark.parametrize(("name", "command"), [*all_commands()], ids=[name for name, _ in all_commands()])
def test_no_word_of_a_help_is_taken_for_markup(name: str, command: TyperCommand) -> None:
    """Help texts contain no markup. Previously, `--workers` of `dpm2 fleet` had lost its default, which was in square
    brackets."""
    texts = [command.help, *(getattr(parameter, "help", None) for parameter in command.params)]
    assert [text for text in texts if text and Text.from_markup(text).plain != text] == []


def test_without_arguments_there_is_the_help_in_groups() -> None:
    done = succeeded()
    assert not done.stderr
    places = [done.stdout.index(f"─ {group} ─") for group in GROUPS]
    assert places == sorted(places)
    for name in (*COMMANDS, "version"):
        assert re.search(rf"^│ {name} ", done.stdout, re.MULTILINE)


def test_a_group_of_commands_without_one_shows_its_help_and_no_error_line() -> None:
    done = dpm2("map")
    assert done.returncode == 2
    assert "Usage" in done.stdout + done.stderr
    assert "dpm2:" not in done.stderr


@pytest.mark.parametrize("width", [60, 100, 200])
def test_help_fits_the_terminal(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERMINAL_WIDTH", str(width))
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", width, raising=False)
    for words in ([], ["run"], ["map", "export"], ["doctor"]):
        shown = dpm2(*words, "--help").stdout
        assert max(map(len, shown.splitlines())) <= width
        assert "…" not in shown


def test_every_command_takes_quiet() -> None:
    missing = [name for name, command in all_commands() if not any("--quiet" in p.opts for p in command.params)]
    assert missing == []


def test_every_command_that_prints_a_table_takes_json() -> None:
    """`show` writes the figures next to the table; `bench` and `train ablation` always write theirs. The table of `map`
    is made in `map_figures`."""
    modules = {path.stem: path.read_text() for path in (ROOT / "dpm2_core" / "commands").glob("*.py")}
    tables = {name for name, text in modules.items() if "_table(" in text or "FigureTable(" in text}
    assert tables - {"train", "map_figures"} == {
        name for name, text in modules.items() if "json_file: JsonFile" in text
    }


def test_json_alone_is_on_stdout(straight: Path, tmp_path: Path) -> None:
    arguments = ["eval", "--gt", straight, "--est", straight, "--lengths", "100"]
    done = dpm2(*arguments, "--json", "-")
    assert json.loads(done.stdout)["ape_rmse_m"] == pytest.approx(0, abs=1e-9)
    written = dpm2(*arguments, "--json", tmp_path / "figures.json")
    assert "APE" in written.stdout
    assert json.loads((tmp_path / "figures.json").read_text()) == json.loads(done.stdout)


@pytest.mark.slow
def test_quiet_leaves_results_and_errors(recording: Path, tmp_path: Path) -> None:
    arguments = ["run", recording, "--frames", "0:3", "--set", "slam.registration=geometric"]
    arguments += ["--set", "slam.loops.descriptors=false"]
    loud = dpm2(*arguments, "--out", tmp_path / "loud")
    quiet = dpm2(*arguments, "--out", tmp_path / "quiet", "--quiet")
    assert "Results in" in loud.stderr
    assert quiet.returncode == 0
    assert quiet.stderr == ""
    assert "APE" in quiet.stdout
    refused("run", recording, "--out", tmp_path / "no", "--frames", "90:", "-q")
    assert "Results in" in dpm2(*arguments, "--out", tmp_path / "loud").stderr  # the next call is not quiet


def test_progress_survives_a_pipe() -> None:
    out = StringIO()
    with progress_bar(Console(file=out)) as bar:
        task = bar.add_task("drive", total=200)
        for _ in range(200):
            bar.update(task, advance=1, description="drive tracking")
    shown = out.getvalue().splitlines()
    assert len(shown) == 10
    assert shown[0].startswith("drive tracking: 20/200")
    assert shown[-1].startswith("drive tracking: 200/200")
    assert "\x1b" not in out.getvalue()


def test_what_is_tracked_comes_as_it_is_and_is_counted_unless_all_is_to_be_quiet(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The last line is shown at the end, however fast the iteration is."""
    for quiet in (False, True):
        before = QUIET.set(quiet)
        assert list(tracked(iter("abcd"), "scans", 4)) == ["a", "b", "c", "d"]
        QUIET.reset(before)
        out, err = capsys.readouterr()
        assert (out, err.splitlines()[-1:]) == ("", [] if quiet else ["scans: 4/4"])


def test_no_color_means_none(straight: Path) -> None:
    """This is independent of the terminal's capabilities."""
    environment = {**os.environ, "FORCE_COLOR": "1", "NO_COLOR": "1"}
    done = dpm2_process("eval", "--gt", straight, "--est", straight, "--lengths", "100", env=environment)
    assert "APE" in done.stdout
    assert not re.search(r"\x1b\[(3\d|4\d|9\d|38|48)", done.stdout)


@pytest.mark.parametrize(("words", "offered"), [
    ("dpm2 doc", ["doctor"]), ("dpm2 map exp", ["export"]), ("dpm2 run --loc", ["--localise"]),
])  # fmt: skip
@pytest.mark.slow
def test_completion(words: str, offered: list[str]) -> None:
    program = "import sys; sys.argv = ['dpm2']; from dpm2_core.cli import main; main()"
    environment = {
        **os.environ, "_DPM2_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")),
    }  # fmt: skip
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == offered


@pytest.mark.slow
def test_ctrl_c_ends_a_command_without_a_traceback_and_at_once(tmp_path: Path) -> None:
    """Ctrl-C ends the command within 10 s: 500 frames would take a minute. A tunnel is built in a tenth of the time of
    a city."""
    drive = ("sim", tmp_path / "drive", "--frames", 500, "--preset", "tunnel", "--no-images")
    with started(*drive, until=lambda: list(tmp_path.rglob("*.bin"))) as process:
        process.send_signal(signal.SIGINT)
        began = time.monotonic()
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert time.monotonic() - began < 10


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["version"], ["--help"], ["config", "dump"], ["eval", "--json", "-"]])
def test_a_full_disk_under_stdout_is_one_line(straight: Path, arguments: list[str]) -> None:
    given = ["--gt", straight, "--est", straight] if "eval" in arguments else []
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "dpm2_core.cli", *map(str, [*arguments, *given])]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (1, "dpm2: output could not be written: No space left on device\n")


@pytest.mark.slow
def test_a_reader_that_stops_early_is_no_error() -> None:
    command = f"{sys.executable} -m dpm2_core.cli config dump | head -1"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout
    assert "Traceback" not in done.stderr


def test_a_loop_of_symbolic_links_is_one_line(tmp_path: Path, map_file: Path) -> None:
    """Before Python 3.13 it ended with a traceback where a new file was to be written."""
    (loop := tmp_path / "loop").symlink_to("loop")
    for arguments in (["map", "prune", map_file, "--out", loop], ["map", "export", map_file, loop, "--format", "ply"]):
        done = dpm2(*arguments)
        assert (done.returncode, done.stderr) == (1, f"dpm2: {loop}: Too many levels of symbolic links\n")
    assert loop.is_symlink()


def test_a_path_that_may_not_be_entered_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Examples are the folder of another user and a name that no file can have: Python raises when checking if it
    exists."""
    name = tmp_path / ("n" * 300)
    for arguments in (["info", name], ["prune", tmp_path / "a", "--out", name], ["export", name, tmp_path / "a.ply"]):
        done = dpm2("map", *arguments)
        assert (done.returncode, done.stderr) == (1, f"dpm2: {name}: File name too long\n")

    def denied() -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "/root/a")

    assert exit_code(denied, "dpm2") == 1
    assert capsys.readouterr().err == "dpm2: /root/a: Permission denied\n"


def test_the_page_of_exit_codes_lists_those_that_there_are() -> None:
    page = (ROOT / "docs" / "exit_codes.md").read_text()
    assert re.findall(r"^\| (\d+) \|", page, re.MULTILINE) == ["0", "1", "2", "130"]
