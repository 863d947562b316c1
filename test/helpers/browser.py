# SPDX-License-Identifier: Apache-2.0
"""A real browser for the pages that dpm2 writes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tools.browser import SOFTWARE, chromium


@contextmanager
def opened(path: Path, width: int = 800, height: int = 600) -> Iterator[tuple[Any, list[str]]]:
    """A page in headless Chromium without a network, and its console output. Skips the test if there is no browser."""
    api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install '.[test]'")
    program = chromium()
    if program is None:
        pytest.skip("no Chromium (Debian: apt install chromium)")
    said: list[str] = []
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(SOFTWARE))
        try:
            context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
            page = context.new_page()
            page.set_default_timeout(120_000)  # software rendering, next to other work
            page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
            page.on("pageerror", lambda error: said.append(f"error: {error}"))
            page.goto(path.as_uri())
            yield page, said
        finally:
            browser.close()


def wait(page: Any, expression: str, seconds: float = 120.0) -> None:
    """Wait until a JavaScript expression is true. `wait_for_function` evaluates a string, which our pages forbid."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"waited {seconds} s for {expression}"
        page.wait_for_timeout(50)
