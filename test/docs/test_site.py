# SPDX-License-Identifier: Apache-2.0
"""The site is built without a warning, and loads nothing from other sites."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages, built strictly: a dead link, a missing anchor or a page that is left out is an error."""
    pytest.importorskip("mkdocs", reason="no mkdocs: pip install '.[docs]'")
    pytest.importorskip("material", reason="no mkdocs-material: pip install '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return out


@pytest.mark.long
def test_every_page_and_every_public_name_is_there(site: Path) -> None:
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert pages <= {path.stem for path in site.glob("*.html")}
    api = (site / "api.html").read_text()
    import dpm2_core

    missing = [name for name in dpm2_core.__all__ if name != "__version__" and f'id="dpm2_core.{name}"' not in api]
    assert missing == []
    assert "covariance" in api


@pytest.mark.long
def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    """Other sites are reached only through links that a reader follows."""
    for page in site.rglob("*.html"):
        loaded = re.findall(r"<(?:script|img|iframe|link)[^>]*?(?:src|href)=[\"']?(https?:[^\"' >]+)", page.read_text())
        assert loaded == [], page
