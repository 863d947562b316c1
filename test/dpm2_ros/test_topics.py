# SPDX-License-Identifier: Apache-2.0
"""docs/topics.md describes the nodes' topics as they are, and names no topic twice."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dpm2_ros.topics import describe, page

PAGE = Path(__file__).resolve().parents[2] / "docs" / "topics.md"


@pytest.mark.slow
def test_the_page_is_that_of_the_nodes(ros: Callable[..., Any]) -> None:
    """The page equals the output of `make topics`. The network is not loaded, since it adds no topic."""
    ros("slam.registration:=geometric", "slam.loops.descriptors:=false", namespace="")
    found = describe()
    assert page(found) == PAGE.read_text()
    for endpoints in found.values():
        assert len({(e.name, e.role) for e in endpoints}) == len(endpoints)
