# SPDX-License-Identifier: Apache-2.0
"""Every code block in the documentation runs or states why not; every call of `dpm2` in it is accepted by dpm2.

A block that is not run has a comment on the line before: `<!-- not run: why -->`.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from typer.core import TyperGroup

from dpm2_core.cli import load_command

from ..helpers.command import dpm2
from ..helpers.drives import first_scans

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(ROOT.glob("docs/*.md")) + [ROOT / name for name in ("README.md", "CONTRIBUTING.md")]
SHOWN = ("mermaid", "text")
"""Languages that cannot be run; mermaid is compared with the imports in test/tools."""
_FENCE = re.compile(r"(?:<!-- not run: (?P<why>[^\n]+) -->\n)?^```(?P<language>\w*)\n(?P<code>.*?)^```$", re.M | re.S)


class Block(NamedTuple):
    """One block of a page; `why` it is not run, or an empty string."""

    page: Path
    line: int
    language: str
    code: str
    why: str

    @property
    def commands(self) -> list[str]:
        """Lines of a shell block without comments; continued lines are joined."""
        joined = self.code.replace("\\\n", " ")
        return [line for line in (re.sub(r"(^|\s)#.*", "", line).strip() for line in joined.splitlines()) if line]


def blocks(page: Path) -> list[Block]:
    """All blocks of a page."""
    text = page.read_text()
    return [
        Block(page, text[: m.start()].count("\n") + 1, m["language"], m["code"], m["why"] or "")
        for m in _FENCE.finditer(text)
    ]


ALL = [block for page in PAGES for block in blocks(page)]
CALLS = [(b, command) for b in ALL if b.language == "sh" for command in b.commands if command.startswith("dpm2 ")]


def test_blocks_are_found_and_have_a_language() -> None:
    fences = sum(len(re.findall(r"^```", page.read_text(), re.M)) for page in PAGES)
    assert 2 * len(ALL) == fences
    assert not [f"{b.page.name}:{b.line}" for b in ALL if not b.language]


@pytest.mark.parametrize(("block", "command"), CALLS, ids=[f"{b.page.stem}:{b.line}" for b, _ in CALLS])
def test_a_call_of_dpm2_is_one_that_it_accepts(block: Block, command: str) -> None:
    """This includes blocks that are not run: the command exists, and so do its options."""
    words = [word.rstrip("].") if word.startswith("[") else word for word in shlex.split(command)[1:]]
    name, *rest = (word for word in words if word not in ("[DRIVE...",))
    if name == "version":
        return
    single = load_command(name)
    if isinstance(single, TyperGroup):
        subcommand, *rest = rest
        single = single.commands[subcommand]  # type: ignore[assignment]
    try:
        single.make_context(name, rest)
    except Exception as error:
        pytest.fail(f"{block.page.name}:{block.line}: {command}: {error}")


@pytest.fixture
def workplace(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a small recording under the names that the pages use."""
    for name in ("DRIVE", "OTHER"):
        first_scans(recording, 9, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


RUN = [page for page in PAGES if any(not b.why and b.language not in SHOWN for b in blocks(page))]


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_the_blocks_of_a_page_run_one_after_the_other(page: Path, workplace: Path) -> None:
    if page.stem == "how_to":  # begins where the quickstart ends
        assert dpm2("run", "DRIVE", "--out", "out/first", "--map", "first.dpm2map").returncode == 0
    for block in blocks(page):
        if block.why or block.language in SHOWN:
            continue
        where = f"{page.name}:{block.line}"
        if block.language == "python":
            exec(compile(block.code, where, "exec"), {"__name__": "__main__"})
        elif block.language == "yaml":
            assert isinstance(yaml.safe_load(block.code), dict), where
        else:
            assert block.language == "sh", f"{where}: nothing runs {block.language}"
            for command in block.commands:
                assert command.startswith("dpm2 "), f"{where}: {command}: is not run here; say why"
                done = dpm2(*shlex.split(command)[1:])
                assert done.returncode == 0, f"{where}: {command}: {done.stderr}"
