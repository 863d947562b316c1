# SPDX-License-Identifier: Apache-2.0
"""Checks the files of `make dist` as users install them: in fresh environments, where the programs are started.

`python -m tools.check_dist`: wheel and sdist with the base install, then the wheel with each extra.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import venv
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import run_command
from dpm2_core.errors import UsageError

PROGRAMS = (("dpm2", "version"), ("dpm2", "config", "dump"), ("dpm2", "doctor", "--no-test"))
NODES = ("slam_node", "mapper_node", "bag_player")


def check(distribution: Path, extra: str, work: Path) -> None:
    """Install a wheel or sdist with an extra ("" for none), and start all programs.

    Raises:
        CalledProcessError: a program does not start.
    """
    place = work / f"{distribution.suffix.strip('.')}-{extra or 'base'}"
    venv.create(place, with_pip=True)
    run = place / "bin"
    wanted = f"{distribution}[{extra}]" if extra else str(distribution)
    # The version of torch that is installed here, so that no environment downloads another one.
    torch = version("torch").partition("+")[0]
    (place / "constraints.txt").write_text(f"torch=={torch}\n", encoding="utf-8")
    pip = [str(run / "pip"), "install", "-qq", "--disable-pip-version-check", "-c", str(place / "constraints.txt")]
    subprocess.run([*pip, wanted], check=True)
    for name, *arguments in PROGRAMS:
        subprocess.run([str(run / name), *arguments], check=True, cwd=work, stdout=subprocess.DEVNULL)
    for name in NODES:
        assert (run / name).is_file(), f"{name} is missing"
    print(f"{distribution.name} with {extra or 'no extras'}: ok")


def check_all(
    dist: Annotated[Path, typer.Argument(help="Folder that `make dist` made.")],
    extras: Annotated[list[str] | None, typer.Argument(metavar="EXTRA...")] = None,
) -> None:
    """Check the wheel and the sdist of a folder."""
    wheels, sdists = sorted(dist.resolve().glob("*.whl")), sorted(dist.resolve().glob("*.tar.gz"))
    if len(wheels) != 1 or len(sdists) != 1:
        raise UsageError(f"{dist}: want one wheel and one sdist; `make dist` makes them")
    with tempfile.TemporaryDirectory() as place:
        for distribution, extra in [(wheels[0], ""), (sdists[0], ""), *((wheels[0], name) for name in extras or ())]:
            check(distribution, extra, Path(place))


if __name__ == "__main__":
    sys.exit(run_command(check_all))
