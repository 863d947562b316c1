# SPDX-License-Identifier: Apache-2.0
"""A page is one file, and external content cannot become markup or script."""

from __future__ import annotations

import base64
import json
from html.parser import HTMLParser

import pytest

from dpm2_core.evaluation.page import data_url, escape, page

HOSTILE = "</script><script>alert(1)</script><!-- <b onclick='x'> & \u2028 \"quoted\""


class Reader(HTMLParser):
    """The elements of a page, and the text in each kind of element."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: dict[str, dict[str, str | None]] = {}
        self.texts: dict[str, str] = {}
        self._open = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes[tag] = dict(attrs)
        self._open = dict(attrs).get("id") or tag

    def handle_data(self, data: str) -> None:
        self.texts[self._open] = self.texts.get(self._open, "") + data


def test_hostile_text_stays_text_wherever_it_stands() -> None:
    made = page(HOSTILE, f'<p title="{escape(HOSTILE)}">{escape(HOSTILE)}</p>', script="run()", data={"name": HOSTILE})
    read = Reader(made)
    assert read.tags.count("script") == 2
    assert "b" not in read.tags
    assert read.texts["title"].strip() == HOSTILE
    assert read.attributes["p"] == {"title": HOSTILE}
    assert json.loads(read.texts["data"]) == {"name": HOSTILE}


def test_nothing_may_be_fetched() -> None:
    made = page("t", "<p>text</p>")
    assert "default-src 'none'" in made
    assert "http://" not in made
    assert "https://" not in made


def test_an_image_within_the_page() -> None:
    kind, _, content = data_url(b"\x89PNG", "image/png").partition(";base64,")
    assert kind == "data:image/png"
    assert base64.b64decode(content) == b"\x89PNG"


@pytest.mark.parametrize("broken", [{"data": [float("nan")]}, {"script": "'</SCRIPT>'"}, {"style": "</style>"}])
def test_what_no_page_can_hold_is_an_error(broken: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"page|JSON"):
        page("t", "", **broken)  # type: ignore[arg-type]
