# SPDX-License-Identifier: Apache-2.0
"""A headless browser for generated pages: which program, and the arguments for software rendering."""

from __future__ import annotations

import shutil

SOFTWARE = ("--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader")
"""Arguments of Chromium."""


def chromium() -> str | None:
    """Path of the program; None if there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
