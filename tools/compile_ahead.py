# SPDX-License-Identifier: Apache-2.0
"""Compile all loops (`geometry.compiled`) ahead of use, with as many processes as there are processors.

A process that finds no compiled code compiles it itself: half a minute, in each of several processes started together.
"""

from __future__ import annotations

import importlib
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import dpm2_core


def compiled_modules() -> list[str]:
    """Names of the modules with compiled loops, those with the most loops first."""
    package = Path(dpm2_core.__file__).parent
    loops = {path: path.read_text().count("\n@compiled(") for path in package.rglob("*.py")}
    paths = sorted((path for path, count in loops.items() if count), key=lambda path: -loops[path])
    return [".".join(path.relative_to(package.parent).with_suffix("").parts) for path in paths]


def compile_module(name: str) -> None:
    """Compile a module's loops by importing it."""
    importlib.import_module(name)


def main() -> None:
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        list(pool.map(compile_module, compiled_modules()))


if __name__ == "__main__":
    main()
