# SPDX-License-Identifier: Apache-2.0
"""The public names: all exist, are documented and typed, and importing the package imports none of their modules."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import dpm2_core

NAMES = [name for name in dpm2_core.__all__ if name != "__version__"]


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_is_what_its_module_has_and_is_documented(name: str) -> None:
    value = getattr(dpm2_core, name)
    assert value is getattr(sys.modules[value.__module__], name)
    assert inspect.getdoc(value)
    assert f"`{name}" in (dpm2_core.__doc__ or "")


def test_type_checkers_see_the_same_names() -> None:
    """They are under TYPE_CHECKING, from the same modules; the package has a py.typed, which is installed."""
    tree = ast.parse(Path(dpm2_core.__file__).read_text(encoding="utf-8"))
    checked = next(node for node in tree.body if isinstance(node, ast.If))
    typed = {
        alias.name: line.module for line in checked.body if isinstance(line, ast.ImportFrom) for alias in line.names
    }
    assert sorted(typed) == sorted(NAMES)
    assert typed == {name: getattr(dpm2_core, name).__module__ for name in NAMES}
    assert (Path(dpm2_core.__file__).parent / "py.typed").is_file()
    setup = (Path(__file__).parents[2] / "setup.py").read_text(encoding="utf-8")
    assert '"py.typed"' in setup


def test_a_name_that_is_not_there_is_an_ordinary_error() -> None:
    assert set(NAMES) <= set(dir(dpm2_core))
    with pytest.raises(AttributeError, match="module 'dpm2_core' has no attribute 'SLAM'"):
        _ = dpm2_core.SLAM  # type: ignore[attr-defined]


def test_the_package_alone_imports_nothing_but_the_standard_library() -> None:
    program = (
        "import sys; before = set(sys.modules); import dpm2_core\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before} - {'dpm2_core'}\n"
        "sys.exit(str(new - sys.stdlib_module_names) if new - sys.stdlib_module_names else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
