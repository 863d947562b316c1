# SPDX-License-Identifier: Apache-2.0
"""Hooks for mkdocs: files outside docs/ that pages link to, as in the repository, become part of the site."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from dpm2_core.extras import needs

ROOT = Path(__file__).resolve().parents[1]
PLACE = "repository"
"""Folder of the site for files of the repository outside docs/."""
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?P<target>[^)#\s]+)(?P<anchor>(?:#[^)\s]*)?)\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the files that the pages link to, and the files that those link to."""
    with needs("docs", "the site"):
        from mkdocs.structure.files import File
    pending = [page.src_uri for page in files.documentation_pages()]
    while pending:
        page = pending.pop()
        for target in _linked(page):
            uri = f"{PLACE}/{target}"
            if not target.startswith("docs/") and (ROOT / target).is_file() and files.get_file_from_path(uri) is None:
                files.append(File.generated(config, uri, abs_src_path=str(ROOT / target)))
                if uri.endswith(".md"):
                    pending.append(uri)
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace the links of a page by the targets' paths in the site."""
    source = page.file.src_uri

    def site_link(match: re.Match[str]) -> str:
        target = _in_repository(source, match["target"])
        if target is None:
            return match[0]
        if (ROOT / target).is_dir():  # a site cannot show a folder
            return match["text"]
        uri = target.removeprefix("docs/") if target.startswith("docs/") else f"{PLACE}/{target}"
        relative = posixpath.relpath(uri, posixpath.dirname(source) or ".")
        return f"[{match['text']}]({relative}{match['anchor']})"

    return _LINK.sub(site_link, markdown)


def _linked(page: str) -> list[str]:
    text = (ROOT / (page.removeprefix(f"{PLACE}/") if page.startswith(f"{PLACE}/") else f"docs/{page}")).read_text()
    targets = (_in_repository(page, match["target"]) for match in _LINK.finditer(text))
    return [target for target in targets if target is not None]


def _in_repository(page: str, link: str) -> str | None:
    """Path, relative to the root, of the target of a page's link; None for an address elsewhere."""
    if "://" in link or link.startswith("mailto:"):
        return None
    path = page.removeprefix(f"{PLACE}/") if page.startswith(f"{PLACE}/") else f"docs/{page}"
    return posixpath.normpath(posixpath.join(posixpath.dirname(path), link))
