# SPDX-License-Identifier: Apache-2.0
"""One-file HTML pages: they contain everything, fetch nothing, and show the content of files only as text."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{title}</title>
<style>
{style}
</style>
</head>
<body>
{body}
{data}{script}</body>
</html>
"""
# What the page may do, whatever it contains: its own scripts and styles, nothing from elsewhere.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data: blob:"


def page(title: str, body: str, *, style: str = "", script: str = "", data: Any = None) -> str:
    """An HTML page that needs no other file and no network.

    Args:
        title: text. body: HTML; text in it from elsewhere must have passed `escape`. style: CSS.
        script: JavaScript, run at the end of the page. data: anything that JSON can represent; the script reads it by
            `JSON.parse(document.getElementById("data").textContent)`.

    Raises:
        ValueError: a number in `data` is not finite, or `style` or `script` would end its own element.
    """
    for name, text in (("style", style), ("script", script)):
        if f"</{name}" in text.lower():
            raise ValueError(f"</{name} within the {name} of a page")
    data_element = "" if data is None else f'<script type="application/json" id="data">{_json(data)}</script>\n'
    script_element = f"<script>\n{script}\n</script>\n" if script else ""
    return _PAGE.format(
        policy=_POLICY, title=escape(title), style=style, body=body, data=data_element, script=script_element
    )


def asset(name: str) -> str:
    """The text of a file of this package for a page."""
    return (Path(__file__).with_name("assets") / name).read_text(encoding="utf-8")


def escape(text: object) -> str:
    """Escape text for the body or an attribute."""
    return html.escape(str(text))


def data_url(content: bytes, media: str) -> str:
    """Content such as a PNG as the address of an image; `media`: its type, such as `image/png`."""
    return f"data:{media};base64,{base64.b64encode(content).decode('ascii')}"


def _json(data: Any) -> str:
    """JSON that cannot end the HTML element that contains it."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
