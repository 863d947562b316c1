# SPDX-License-Identifier: Apache-2.0
"""The files of `make dist` as a user gets them: installed into fresh environments, and the programs started there.

python -m tools.check_dist DIST [EXTRA...]: wheel and sdist with the base install, then the wheel with each extra.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from dpm2_core.errors import UsageError, exit_code

PROGRAMS = (("dpm2", "version"), ("dpm2", "config", "dump"), ("dpm2", "doctor", "--no-test"))
NODES = ("slam_node", "mapper_node", "bag_player")


def check(distribution: Path, extra: str, work: Path) -> None:
    """Install a wheel or sdist with an extra ("" for none), and start everything.

    Raises:
        CalledProcessError: something does not start.
    """
    place = work / f"{distribution.suffix.strip('.')}-{extra or 'base'}"
    venv.create(place, with_pip=True)
    run = place / "bin"
    wanted = f"{distribution}[{extra}]" if extra else str(distribution)
    # The torch that is here already, so that each environment need not fetch its own.
    (place / "constraints.txt").write_text(f"torch=={_torch()}\n", encoding="utf-8")
    pip = [str(run / "pip"), "install", "-qq", "--disable-pip-version-check", "-c", str(place / "constraints.txt")]
    subprocess.run([*pip, wanted], check=True)
    for name, *arguments in PROGRAMS:
        subprocess.run([str(run / name), *arguments], check=True, cwd=work, stdout=subprocess.DEVNULL)
    for name in NODES:
        assert (run / name).is_file(), f"{name} is missing"
    print(f"{distribution.name} with {extra or 'nothing more'}: sound")


def _torch() -> str:
    import torch

    return str(torch.__version__).partition("+")[0]


def main() -> int:
    """Check what is named."""

    def work() -> None:
        if len(sys.argv) < 2:
            raise UsageError("usage: python -m tools.check_dist DIST [EXTRA...]")
        folder = Path(sys.argv[1]).resolve()
        wheels, sdists = sorted(folder.glob("*.whl")), sorted(folder.glob("*.tar.gz"))
        if len(wheels) != 1 or len(sdists) != 1:
            raise UsageError(f"{folder}: want one wheel and one sdist; `make dist` makes them")
        with tempfile.TemporaryDirectory() as place:
            for distribution, extra in [(wheels[0], ""), (sdists[0], ""), *((wheels[0], e) for e in sys.argv[2:])]:
                check(distribution, extra, Path(place))

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
