# SPDX-License-Identifier: Apache-2.0
"""A browser without a screen for the pages that are written: which program, and rendered in software."""

from __future__ import annotations

import shutil

SOFTWARE = ("--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader")
"""Arguments of Chromium."""


def chromium() -> str | None:
    """The program; None where there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
