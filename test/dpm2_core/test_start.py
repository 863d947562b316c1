# SPDX-License-Identifier: Apache-2.0
"""Programs start fast: imports do not change the environment, and a command loads only what it needs."""

from __future__ import annotations

import subprocess
import sys

import pytest

from dpm2_core.cli import COMMANDS, load_command


def python(program: str) -> str:
    """Output of a program in a process without the settings of OpenMP."""
    program = f"import os; [os.environ.pop(n, 0) for n in ('OMP_WAIT_POLICY', 'GOMP_SPINCOUNT')]\n{program}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_lists_every_command_with_its_own_first_paragraph(name: str) -> None:
    """The paragraph is repeated in cli.py, so that `dpm2 --help` need not import the command."""
    assert COMMANDS[name][1] == (load_command(name).help or "").split("\n\n")[0]


def test_the_help_imports_no_command_and_no_array() -> None:
    heavy = "{'numpy', 'scipy', 'gtsam', 'torch', 'cv2', 'pydantic', 'dpm2_core.commands.run'}"
    output = python(
        "import sys; from dpm2_core.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        f"print('imported', {heavy} & set(sys.modules))"
    )
    assert "imported set()" in output
    assert all(name in output for name in COMMANDS)


@pytest.mark.slow
def test_an_import_sets_no_environment_variable() -> None:
    """Variables that cv2 sets itself are excluded."""
    python(
        "import os, cv2; before = dict(os.environ)\n"
        "import dpm2_core, dpm2_core.cli, dpm2_core.slam.system, dpm2_ros.executables\n"
        "assert dict(os.environ) == before, set(os.environ.items()) ^ set(before.items())"
    )


@pytest.mark.slow
@pytest.mark.parametrize("entry", [
    "from dpm2_core.cli import main as entry; arguments = ['version']",
    "from dpm2_ros.executables import bag_player as entry; arguments = ['nowhere']",
])  # fmt: skip
def test_the_entry_of_a_program_lets_idle_threads_sleep_before_numpy_is_there(entry: str) -> None:
    """OpenMP reads the environment only once; see `dpm2_core.openmp`."""
    output = python(
        f"import os, sys; {entry}\n"
        "assert 'numpy' not in sys.modules\n"
        "try: entry(arguments)\n"
        "except SystemExit: pass\n"
        "print(*(os.environ[name] for name in ('OMP_WAIT_POLICY', 'GOMP_SPINCOUNT', 'OPENBLAS_NUM_THREADS')))"
    )
    assert "passive 20000 1" in output


@pytest.mark.parametrize("name", ["run", "eval", "map", "show", "convert"])
def test_the_help_of_what_is_called_most_imports_no_slam(name: str) -> None:
    """The help and the shell's completion of options import no large modules; previously, this took 1.5 s."""
    output = python(
        "import sys; from dpm2_core.cli import main\n"
        f"try: main(['{name}', '--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "print('imported', {'numpy', 'scipy', 'numba', 'gtsam', 'torch', 'cv2'} & set(sys.modules))"
    )
    assert "imported set()" in output


def test_a_player_of_bags_starts_without_what_reads_their_messages() -> None:
    """Modules that read and register messages are not imported; previously, they took two thirds of the start."""
    output = python(
        "import sys; from dpm2_ros.executables import bag_player\n"
        "assert bag_player(['nowhere']) == 2\n"
        "print('imported', {'numba', 'scipy', 'gtsam', 'cv2', 'torch'} & set(sys.modules))"
    )
    assert "imported set()" in output


def test_a_simulator_starts_without_the_filter_of_an_imu() -> None:
    """scipy.signal is not imported; previously, it took half of the start."""
    assert python("import sys, dpm2_core.sim.drive; print('scipy.signal' in sys.modules)") == "False\n"


def test_what_the_user_chose_stays() -> None:
    output = python(
        "import os; os.environ['OMP_WAIT_POLICY'], os.environ['OPENBLAS_NUM_THREADS'] = 'active', '2'\n"
        "from dpm2_core.openmp import wait_passively; wait_passively()\n"
        "print(os.environ['OMP_WAIT_POLICY'], os.environ['OPENBLAS_NUM_THREADS'])"
    )
    assert output == "active 2\n"


@pytest.mark.slow
def test_the_compiled_loops_need_no_folder_to_write_to() -> None:
    """They are then compiled again, with the same result."""
    output = python(
        "import numba.core.caching as caching; caching.CacheImpl._locator_classes = []\n"
        "import numpy as np; from dpm2_core.geometry.voxel import voxel_first\n"
        "print(voxel_first(np.array([[0, 0, 0], [0.1, 0, 0], [1, 0, 0.]]), 0.5))"
    )
    assert "[0 2]" in output
