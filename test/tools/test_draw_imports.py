# SPDX-License-Identifier: Apache-2.0
"""The diagrams of docs/architecture.md show the imports, and leave out only those that other arrows imply."""

from __future__ import annotations

import pytest

from dpm2_core.errors import Dpm2Error, UsageError
from tools.draw_imports import BASE, DOCUMENT, children, diagrams, packages, reachable, reduced, replaced

grimp = pytest.importorskip("grimp")


def test_the_document_shows_the_imports_as_they_are() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert replaced(text, diagrams()) == text, "the imports have changed: run `make diagrams`"


def test_every_import_between_packages_can_be_followed_in_the_diagram() -> None:
    """There is nothing else: along the arrows, exactly the imported packages can be reached."""
    graph = grimp.build_graph("dpm2_core", "dpm2_ros", cache_dir=None)
    for arrows in (packages(graph), children(graph, "dpm2_core.slam")):
        drawn = reduced(arrows)
        assert sum(map(len, drawn.values())) < sum(map(len, arrows.values()))
        assert all(reachable(drawn, unit) == reachable(arrows, unit) for unit in arrows)
    assert {"dpm2_ros", "dpm2_core.slam", "dpm2_core.network", BASE} <= set(packages(graph))


def test_arrows_that_others_imply_are_left_out() -> None:
    assert reduced({"a": {"b", "c", "d"}, "b": {"c"}, "c": {"d"}, "d": set()}) == {
        "a": {"b"}, "b": {"c"}, "c": {"d"}, "d": set(),
    }  # fmt: skip


def test_a_circle_and_a_document_without_a_place_are_errors() -> None:
    with pytest.raises(Dpm2Error, match="circular imports: a, b"):
        reduced({"a": {"b"}, "b": {"a"}, "c": {"a"}})
    with pytest.raises(UsageError, match="no <!-- imports: slam -->"):
        replaced("<!-- imports: packages -->\n<!-- end -->\n", {"slam": "flowchart TD\n"})


def test_drawing_anew_replaces_what_was_drawn_and_nothing_else() -> None:
    text = "before\n<!-- imports: slam -->\nold\n<!-- end -->\nafter\n"
    once = replaced(text, {"slam": "flowchart TD\n"})
    assert once == "before\n<!-- imports: slam -->\n```mermaid\nflowchart TD\n```\n<!-- end -->\nafter\n"
    assert replaced(once, {"slam": "flowchart TD\n"}) == once
