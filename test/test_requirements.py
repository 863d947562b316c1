# SPDX-License-Identifier: Apache-2.0
"""setup.py declares what the code imports, and packages of an extra are imported only where they are needed."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
WITH_ANOTHER_WAY = {"kiss_icp", "pypose", "small_gicp"}  # a benchmark reports itself if they are missing
WITHOUT_DEPENDENCIES = {"ouster"}  # pip install --no-deps: its dependencies contradict the base install's
FILES = sorted(
    path
    for folder in ("dpm2_core", "dpm2_ros", "benchmarks", "tools", "launch")
    for path in (ROOT / folder).rglob("*.py")
)


@pytest.fixture(scope="module")
def declared(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Requirement]]:
    """Requirements of the base install ("") and of each extra, as pip reads them."""
    folder = tmp_path_factory.mktemp("egg")
    command = [sys.executable, "setup.py", "-q", "egg_info", "-e", str(folder)]
    environment = {name: value for name, value in os.environ.items() if name != "ROS_DISTRO"}
    subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
    (path,) = folder.glob("*.egg-info/requires.txt")
    out: dict[str, list[Requirement]] = {"": []}
    section = marker = ""
    for line in filter(None, path.read_text().splitlines()):
        if head := re.fullmatch(r"\[([\w-]*):?(.*)\]", line):
            section, marker = head.groups()
            out.setdefault(section, [])
        else:
            out[section].append(Requirement(f"{line}; {marker}" if marker else line))
    return out


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@cache
def _distributions() -> dict[str, list[str]]:
    return dict(packages_distributions())


def _distribution(module: str) -> set[str]:
    """Distributions that an import may come from; if not installed, the module's name."""
    return {_normal(name) for name in [*_distributions().get(module, []), module]}


def _imports(tree: ast.AST, extra: str | None = None, inside: bool = False) -> Iterator[tuple[str, str | None, bool]]:
    """Third-party top-level modules, the extra of the surrounding `with needs(...)`, and whether within a function."""
    for node in ast.iter_child_nodes(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            names = [node.module]
        for name in names:
            top = name.partition(".")[0]
            if top not in sys.stdlib_module_names and top not in ("dpm2_core", "dpm2_ros", "benchmarks", "tools"):
                yield top, extra, inside
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        here = extra
        if isinstance(node, ast.With):
            for item in node.items:
                call = item.context_expr
                if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "needs":
                    here = ast.literal_eval(call.args[0])
        yield from _imports(node, here, inside or isinstance(node, ast.FunctionDef))


def _of_ros(module: str) -> bool:
    """Whether a module comes with ROS 2: as a wheel, or as a package that package.xml declares or its generators
    provide."""
    depends = {element.text for element in ET.parse(ROOT / "package.xml").getroot().findall("exec_depend")}
    return module in depends or any(name.startswith("ros-") for name in _distributions().get(module, []))


@pytest.mark.slow
def test_every_import_is_declared_where_it_is_needed(declared: dict[str, list[Requirement]]) -> None:
    wrong, seen = [], set()
    extras = {_normal(r.name): extra for extra, rows in declared.items() if extra not in ("", "dev") for r in rows}
    base = {_normal(r.name) for r in declared[""]}
    for path in FILES:
        for module, extra, inside in _imports(ast.parse(path.read_text())):
            seen.add(module)
            where = f"{path.relative_to(ROOT)}: {module}"
            if _distribution(module) & base or (_of_ros(module) and path.parts[len(ROOT.parts)] != "dpm2_core"):
                continue
            (owner,) = {extras[name] for name in _distribution(module) if name in extras} or {None}
            if owner is None and module in WITHOUT_DEPENDENCIES and inside:
                continue
            if owner is None:
                wrong.append(f"{where} is declared nowhere")
            elif not inside:
                wrong.append(f"{where} of the extra {owner} is imported with the module")
            elif extra != owner and module not in WITH_ANOTHER_WAY:
                wrong.append(f"{where} of the extra {owner} is imported as of {extra}")
    assert not wrong, "\n".join(wrong)
    assert {"numpy", "annotated_types", "contourpy", "matplotlib", "laspy", "rclpy"} <= seen  # the scan finds them


@pytest.mark.slow
def test_what_is_declared_for_the_base_install_is_imported(declared: dict[str, list[Requirement]]) -> None:
    imported = {
        name for path in FILES for module, *_ in _imports(ast.parse(path.read_text())) for name in _distribution(module)
    }
    unused = {_normal(r.name) for r in declared[""] if not r.name.startswith("ros-")} - imported
    assert not unused


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_a_machine_is_asked_only_for_what_exists_for_it(declared: dict[str, list[Requirement]], machine: str) -> None:
    """Checked in the package index: embreex and ros-rclpy have no wheels for aarch64."""
    environment = {"platform_machine": machine, "python_version": "3.12", "sys_platform": "linux"}
    requested = {
        _normal(r.name): str(r.specifier)
        for rows in declared.values()
        for r in rows
        if r.marker is None or r.marker.evaluate(environment)
    }
    assert ("embreex" in requested) is ("ros-rclpy" in requested) is (machine == "x86_64")


def test_what_make_demo_and_make_test_install_has_their_extras() -> None:
    (line,) = (text for text in (ROOT / "Makefile").read_text().splitlines() if text.startswith("EXTRAS ?="))
    assert {"plot", "sim", "test"} <= set(line.partition("=")[2].strip().split(","))


def test_make_dist_check_installs_every_extra_of_a_user(declared: dict[str, list[Requirement]]) -> None:
    """Its help names what it leaves out: programs to compare with, release tools, and the extra that combines
    others."""
    extras = r"^dist-check:.* every extra but (.*)\n\t.*tools\.check_dist dist (.*)$"
    ((left_out, installed),) = re.findall(extras, (ROOT / "Makefile").read_text(), re.M)
    assert set(re.findall(r"\w+", left_out.replace(" and ", " "))) == {"peers", "release", "dev"}
    assert set(installed.split()) == declared.keys() - {"", "peers", "release", "dev"}
