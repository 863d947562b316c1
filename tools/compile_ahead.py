# SPDX-License-Identifier: Apache-2.0
"""Make the machine code of all loops (`geometry.compiled`), by as many processes as there are processors.

Each process that needs it and finds none makes it for itself: half a minute, in every one of those that start together.
"""

from __future__ import annotations

import importlib
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import dpm2_core


def compiled_modules() -> list[str]:
    """Names of the modules with loops that are compiled, those with most of them first."""
    package = Path(dpm2_core.__file__).parent
    loops = {path: path.read_text().count("\n@compiled(") for path in package.rglob("*.py")}
    paths = sorted((path for path, count in loops.items() if count), key=lambda path: -loops[path])
    return [".".join(path.relative_to(package.parent).with_suffix("").parts) for path in paths]


def compile_module(name: str) -> None:
    """By importing it."""
    importlib.import_module(name)


def main() -> None:
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        list(pool.map(compile_module, compiled_modules()))


if __name__ == "__main__":
    main()
