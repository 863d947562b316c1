# SPDX-License-Identifier: Apache-2.0
"""The layout for Foxglove names what the nodes have: topics, fields of messages, services; and no panel is lost."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dpm2_ros.message_types import message_type

ROOT = Path(__file__).resolve().parents[2]
LAYOUT = json.loads((ROOT / "config" / "foxglove.json").read_text())
# docs/topics.md is compared with running nodes in test_topics.py
ROWS = re.findall(r"^\| `([^`]+)` \| (\S+) \|", (ROOT / "docs" / "topics.md").read_text(), re.M)
KINDS = dict(ROWS)


def texts(value: Any) -> Iterator[str]:
    """All keys and values that are text."""
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
    """The leaves of the arrangement."""
    if isinstance(layout, str):
        return [layout]
    return [*panels(layout["first"]), *panels(layout["second"])]


def test_every_topic_and_service_is_there() -> None:
    named = {text for text in texts(LAYOUT) if text.startswith("/")}
    assert len(named) >= 9
    for text in named:
        name = re.split(r"[.\[]", text)[0]
        known = name in KINDS or name.replace("/slam_node/", "~/") in KINDS
        assert known, f"{text} is neither a topic nor a service of the nodes"


def test_every_field_that_is_plotted_is_in_its_message() -> None:
    paths = [path["value"] for path in LAYOUT["configById"]["Plot!speed"]["paths"]]
    for path in paths:
        name, *fields = path.split(".")
        kind = message_type(KINDS[name])
        assert kind is not None
        value: Any = kind()
        for field in fields:
            value = getattr(value, field.partition("[")[0])
        if "[" in path:
            value = value[int(path.split("[")[1].rstrip("]"))]
        assert float(value) == 0.0


def test_every_panel_has_its_place() -> None:
    assert sorted(panels(LAYOUT["layout"])) == sorted(LAYOUT["configById"])
