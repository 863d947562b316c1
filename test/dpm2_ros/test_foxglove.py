# SPDX-License-Identifier: Apache-2.0
"""The layouts for Foxglove use existing topics, message fields and services of the nodes; and no panel is lost."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dpm2_ros.message_types import message_type

ROOT = Path(__file__).resolve().parents[2]
LAYOUTS = sorted((ROOT / "config").glob("foxglove*.json"))
ROBOTS = re.compile(r"^/(red|green|blue)(?=/)")  # namespaces of the robots
# docs/topics.md is compared with running nodes in test_topics.py
ROWS = re.findall(r"^\| `([^`]+)` \| (\S+) \|", (ROOT / "docs" / "topics.md").read_text(), re.M)
KINDS = dict(ROWS)


def texts(value: Any) -> Iterator[str]:
    """All keys and values that are strings."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from texts(item)
    elif isinstance(value, list):
        for item in value:
            yield from texts(item)
    elif isinstance(value, str):
        yield value


def panels(layout: Any) -> list[str]:
    """The leaves of the layout tree."""
    if isinstance(layout, str):
        return [layout]
    return [*panels(layout["first"]), *panels(layout["second"])]


@pytest.fixture(params=LAYOUTS, ids=lambda path: path.stem)
def layout(request: pytest.FixtureRequest) -> Any:
    return json.loads(request.param.read_text())


def test_there_are_layouts_for_mapping_localization_and_several_robots() -> None:
    assert [path.stem for path in LAYOUTS] == ["foxglove", "foxglove_localization", "foxglove_robots"]


def test_every_topic_and_service_is_there(layout: Any) -> None:
    named = {ROBOTS.sub("", text) for text in texts(layout) if text.startswith("/")}
    assert len(named) >= 8
    for text in named:
        name = re.split(r"[.\[]", text)[0]
        known = name in KINDS or re.sub(r"^/(slam|mapper)_node/", "~/", name) in KINDS
        assert known, f"{text} is neither a topic nor a service of the nodes"


def test_every_field_that_is_drawn_is_in_its_message(layout: Any) -> None:
    panels = [panel for name, panel in layout["configById"].items() if name.startswith(("Plot!", "StateTransitions!"))]
    assert panels
    for path in (path["value"] for panel in panels for path in panel["paths"]):
        name, *fields = ROBOTS.sub("", path).split(".")
        kind = message_type(KINDS[name])
        assert kind is not None
        value: Any = kind()
        for field in fields:
            value = getattr(value, field.partition("[")[0])
        if "[" in path:
            value = value[int(path.split("[")[1].rstrip("]"))]
        assert value in (0.0, "")


def test_every_panel_has_its_place(layout: Any) -> None:
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
