# SPDX-License-Identifier: Apache-2.0
"""Draws the diagrams of docs/architecture.md from the imports themselves: `make diagrams`.

An arrow means "imports". Arrows implied by others are left out; imports inside functions and for types count, too.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from dpm2_core.errors import Dpm2Error, UsageError, exit_code
from dpm2_core.extras import needs
from dpm2_core.files import atomic_write

if TYPE_CHECKING:
    from grimp import ImportGraph

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = ROOT / "docs" / "architecture.md"
BASE = "base"
Arrows = dict[str, set[str]]
"""Each unit of a diagram, with the units that it imports."""


def diagrams() -> dict[str, str]:
    """Mermaid text of every diagram, by its name in the document.

    Raises:
        MissingPackageError: grimp, which reads the imports, is not installed.
    """
    with needs("lint", "drawing the imports"):
        import grimp
    graph = grimp.build_graph("dpm2_core", "dpm2_ros", cache_dir=None)
    return {"packages": _mermaid(packages(graph)), "slam": _mermaid(children(graph, "dpm2_core.slam"))}


def packages(graph: ImportGraph) -> Arrows:
    """The packages; single files that import only each other are drawn as one, `BASE`."""
    arrows = children(graph, "dpm2_core", "dpm2_ros")
    files = {u for u in arrows if not graph.find_children(u) and graph.find_modules_that_directly_import(u)}
    base: set[str] = set()
    while more := {file for file in files - base if arrows[file] <= base}:
        base |= more
    name = {unit: BASE if unit in base else unit for unit in arrows}
    out: Arrows = {name[unit]: set() for unit in arrows}
    for unit, imported in arrows.items():
        out[name[unit]] |= {name[other] for other in imported} - {name[unit]}
    return out


def children(graph: ImportGraph, parent: str, *others: str) -> Arrows:
    """The modules and packages directly below `parent`, and `others`, with the imports between them."""
    units = sorted(graph.find_children(parent) | set(others))
    out: Arrows = {unit: set() for unit in units}
    for unit in units:
        for module in {unit, *graph.find_descendants(unit)}:
            for imported in graph.find_modules_directly_imported_by(module):
                other = next((u for u in units if imported == u or imported.startswith(f"{u}.")), unit)
                out[unit] |= {other} - {unit}
    return out


def reachable(arrows: Mapping[str, set[str]], start: str) -> set[str]:
    """All units that `start` imports, directly or indirectly."""
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        more = arrows[waiting.pop()] - seen
        seen |= more
        waiting += more
    return seen


def reduced(arrows: Mapping[str, set[str]]) -> Arrows:
    """The smallest set of arrows with the same reachability.

    Raises:
        Dpm2Error: there is an import cycle.
    """
    below = {unit: reachable(arrows, unit) for unit in arrows}
    if circle := sorted(unit for unit in arrows if unit in below[unit]):
        raise Dpm2Error(f"circular imports: {', '.join(circle)}")
    return {
        unit: {other for other in imported if not any(other in below[between] for between in imported)}
        for unit, imported in arrows.items()
    }


def replaced(text: str, drawn: Mapping[str, str]) -> str:
    """A document with its diagrams replaced; each is between `<!-- imports: NAME -->` and `<!-- end -->`.

    Raises:
        UsageError: the document has no place for a diagram.
    """
    for name, mermaid in drawn.items():
        section = re.search(rf"(?<=<!-- imports: {name} -->\n).*?(?=<!-- end -->)", text, re.DOTALL)
        if section is None:
            raise UsageError(f"no <!-- imports: {name} --> with an <!-- end --> to draw between")
        text = f"{text[: section.start()]}```mermaid\n{mermaid}```\n{text[section.end() :]}"
    return text


def _mermaid(arrows: Arrows) -> str:
    """A top-down diagram, in an order that depends only on the names."""
    lines = ["flowchart TD"]
    # "graph" and "end" are keywords of Mermaid: the names of nodes get an underscore.
    lines += [f'    {_node(unit)}["{_label(unit, arrows)}"]' for unit in sorted(arrows)]
    for unit, imported in sorted(reduced(arrows).items()):
        lines += [f"    {_node(unit)} --> {_node(other)}" for other in sorted(imported)]
    return "\n".join(lines) + "\n"


def _node(unit: str) -> str:
    return unit.rpartition(".")[2] + "_"


def _label(unit: str, arrows: Arrows) -> str:
    """The name, and for a package also the first words of its docstring."""
    path = ROOT.joinpath(*unit.split("."))
    if unit == BASE:
        return "frame, estimates, config, errors, files, ...<br/>data types, settings, files"
    if not path.is_dir():
        return f"{path.name}.py"
    doc = ast.get_docstring(ast.parse((path / "__init__.py").read_text(encoding="utf-8"))) or ""
    words = re.split(r"[.:;]( |$)|, as ", doc.split("\n")[0].replace("`", ""), maxsplit=1)[0]
    return f"<b>{path.name}</b><br/>{words}"


def main() -> None:
    """Update the diagrams in the document to the current imports."""
    text = DOCUMENT.read_text(encoding="utf-8")
    with atomic_write(DOCUMENT) as file:
        file.write(replaced(text, diagrams()))


if __name__ == "__main__":
    sys.exit(exit_code(main, "draw_imports"))
