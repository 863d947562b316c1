# SPDX-License-Identifier: Apache-2.0
"""The base install works without the extras: commands that need one name it in one line."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.data.pcd import write_las
from dpm2_core.extras import MissingPackageError, needs

BASE_INSTALL = """
import sys

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"contourpy", "embreex", "laspy", "matplotlib", "timm", "trimesh"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, NotInstalled())
from dpm2_core.cli import main
main(sys.argv[1:])
"""
"""The command in an environment without the packages of the extras."""
SCANS, COMMANDS = 4, ("bench", "config", "convert", "eval", "map", "run", "show", "sim", "train")


def dpm2(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", BASE_INSTALL, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_every_command_starts_without_extras() -> None:
    done = dpm2("--help")
    assert done.returncode == 0, done.stderr
    assert all(command in done.stdout for command in COMMANDS)


@pytest.mark.slow
def test_a_run_needs_no_extra_and_says_which_file_is_not_there(recording: Path, tmp_path: Path) -> None:
    done = dpm2("run", recording, "--out", tmp_path, "--frames", f":{SCANS}")
    assert done.returncode == 0, done.stderr
    names = {path.name for path in tmp_path.iterdir()}
    assert {"map.ply", "trajectory_kitti.txt", "timing.json"} <= names
    assert "trajectory.png" not in names
    assert len((tmp_path / "trajectory_kitti.txt").read_text().splitlines()) == SCANS
    assert "no trajectory.png: drawing needs the package matplotlib" in done.stderr
    assert "pip install 'dpm2_ros[plot]'" in done.stderr


@pytest.mark.slow
def test_the_simulator_says_in_one_line_which_extra_it_needs(tmp_path: Path) -> None:
    done = dpm2("sim", tmp_path / "city", "--frames", 1)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("dpm2: the synthetic city needs the package ")
    assert last.endswith("pip install 'dpm2_ros[sim]'")


def test_las_names_the_extra_of_this_distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingPackageError, match=r"LAS needs the package laspy, .*: pip install 'dpm2_ros\[las\]'$"):
        write_las(tmp_path / "a.las", np.zeros((3, 4), np.float32))
    assert not list(tmp_path.iterdir())


def test_a_package_that_no_installation_could_bring_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    monkeypatch.setitem(sys.modules, "embreex", None)
    expected = pytest.raises(MissingPackageError, match=r"needs the package embreex, which does not exist for aarch64$")
    with expected, needs("sim", "the city"):
        import embreex  # noqa: F401


def test_an_error_inside_a_package_is_no_missing_package() -> None:
    with pytest.raises(ImportError, match="cannot import name") as caught, needs("sim", "the city"):
        from json import no_such_name  # noqa: F401
    assert not isinstance(caught.value, MissingPackageError)


def test_a_library_that_the_system_lacks_is_named_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As libusb of Open3D, which KISS-SLAM imports. Previously, `dpm2 experiment --peer kiss-slam` ended in a
    traceback."""

    def build(name: str, code: str, *options: str) -> None:
        command = ["g++", "-shared", "-fPIC", "-x", "c++", "-", "-o", name, *options]
        subprocess.run(command, input=code, text=True, cwd=tmp_path, check=True)

    build("libgone.so", "void f() {}")
    build("needsgone.so", "void f(); void g() { f(); }", "-L.", "-lgone")
    (tmp_path / "libgone.so").unlink()
    monkeypatch.syspath_prepend(tmp_path)
    problem = r"^KISS-SLAM needs a library that this system lacks: libgone.so: cannot open shared object file"
    with pytest.raises(MissingPackageError, match=problem), needs("peers", "KISS-SLAM"):
        importlib.import_module("needsgone")
