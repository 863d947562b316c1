# SPDX-License-Identifier: Apache-2.0
"""One version: every source reports that of dpm2_core/_version.py."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

import dpm2_core

ROOT = Path(__file__).resolve().parents[1]


def _of_setup() -> str:
    command = [sys.executable, "setup.py", "--version"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()[-1]


def _of_changelog() -> str:
    (first,) = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)[:1]
    return first


@pytest.mark.parametrize(
    ("where", "version"),
    [
        ("setup.py", _of_setup),
        ("package.xml", lambda: ET.parse(ROOT / "package.xml").getroot().findtext("version")),
        ("CITATION.cff", lambda: yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"]),
        ("the newest of CHANGELOG.md", _of_changelog),
    ],
)
def test_the_version_is_the_same_everywhere(where: str, version: Callable[[], str | None]) -> None:
    assert version() == dpm2_core.__version__, where
