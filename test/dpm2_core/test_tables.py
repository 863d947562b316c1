# SPDX-License-Identifier: Apache-2.0
"""Tables fit the terminal and show everything, however narrow it is."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console, RenderableType

from benchmarks import geometric, neural_view
from dpm2_core.tables import FigureTable, cells_of

ROOT = Path(__file__).resolve().parents[2]
WIDTHS = (60, 80, 120)
word = st.text("abcdefg0123456789.%[]", min_size=1, max_size=18)


def lines(shown: RenderableType, width: int) -> list[str]:
    """The lines that a terminal of that width shows."""
    console = Console(width=width, color_system=None, force_terminal=True)
    with console.capture() as capture:
        console.print(shown)
    return capture.get().splitlines()


def table(**columns: Any) -> FigureTable:
    """Two drives with figures, and text on the right if there are such columns."""
    out = FigureTable("two drives", names=["drive", "method"], **columns)
    text = "as the development kit does it, over segments of 100 to 800 m from each tenth frame on"
    for drive in ("00", "04"):
        for method in ("dpm2, odometry and map", "another one"):
            figures = [f"{number}.{drive}" for number in range(len(columns["figures"]))]
            out.add_row(drive, method, *figures, *([text] * len(columns.get("text", ()))))
        out.add_section()
    return out


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("columns", [2, 5, 9, 14])
def test_every_figure_is_there_in_full(width: int, columns: int) -> None:
    headings = [f"figure {number} m" for number in range(columns)]
    shown = lines(table(figures=headings), width)
    assert max(map(len, shown)) <= width
    words = re.findall(r"\d+\.0[04]", " ".join(shown))
    assert sorted(words) == sorted(2 * [f"{n}.{drive}" for n in range(columns) for drive in ("00", "04")])
    assert all(heading in "\n".join(shown) for heading in headings)
    assert not any("…" in line or "..." in line for line in shown)


def test_what_fits_stands_upright_and_what_does_not_is_turned() -> None:
    few = lines(table(figures=["RPE m", "APE m"]), 60)
    assert re.search(r"drive +method +RPE m +APE m", few[2])
    assert re.search(r"00 +dpm2, odometry and map +0\.00 +1\.00", "\n".join(few))
    many = lines(table(figures=[f"figure {n}" for n in range(9)]), 60)
    assert any(re.match(r" *drive +00 +00 *$", line) for line in many)
    assert any(re.match(r" *figure 8 +8\.00 +8\.00 *$", line) for line in many)


@pytest.mark.parametrize("width", WIDTHS)
def test_text_is_wrapped_between_words(width: int) -> None:
    shown = lines(table(figures=["t_err"], text=["how it is measured"]), width)
    assert max(map(len, shown)) <= width
    text = " ".join(" ".join(shown).split())
    assert text.count("0.00") == 2
    for part in ("development", "segments"):
        assert text.count(part) == 4


@given(st.data(), st.sampled_from(WIDTHS))
@settings(max_examples=60)
def test_nothing_is_cut_or_interpreted(data: st.DataObject, width: int) -> None:
    """For any cells, all characters are printed, including brackets."""
    count = data.draw(st.integers(1, 8))
    rows = data.draw(st.lists(st.lists(word, min_size=count + 1, max_size=count + 1), min_size=1, max_size=6))
    shown = FigureTable("t", names=["name"], figures=[f"f{n}" for n in range(count)])
    for row in rows:
        shown.add_row(*row)
    printed = lines(shown, width)
    assert max(map(len, printed)) <= width
    tokens = " ".join(printed).split()
    for cell in (cell for row in rows for cell in row):
        assert cell in tokens


def test_one_value_wider_than_the_terminal_is_folded() -> None:
    shown = FigureTable("map", names=["what"], text=["value"], header=False)
    shown.add_row("file", "x" * 100)
    printed = lines(shown, 60)
    assert max(map(len, printed)) <= 60
    assert "".join("".join(printed).split()).count("x") == 100


def test_the_wrong_number_of_cells_is_an_error() -> None:
    with pytest.raises(ValueError, match="2 cells for 3 columns"):
        FigureTable("t", names=["a"], figures=["b", "c"]).add_row("1", "2")


@pytest.mark.parametrize("width", WIDTHS)
def test_records_of_benchmarks_are_shown_in_full(width: int) -> None:
    """Figures are never truncated; previously, `dpm2 bench geometric` printed 0.0... in 80 columns."""
    drives = json.loads((ROOT / "benchmarks" / "geometric.json").read_text())["drives"]
    printed = lines(geometric.view(drives), width)
    assert max(map(len, printed)) <= width
    text = "\n".join(printed)
    for methods in drives.values():
        for method, row in methods.items():
            assert method in text
            assert f"{row['rpe_trans_m']:.3f}" in text
            assert f"{row['t_err_percent']:.3f}" in text
            assert f"{row['cpu_ms']:.{2 if method.startswith('ratio') else 0}f}" in text
    printed = lines(neural_view.view(json.loads((ROOT / "benchmarks" / "neural.json").read_text())["parts"]), width)
    assert max(map(len, printed)) <= width
    assert not any("…" in line for line in printed)


def test_all_tables_are_of_this_kind() -> None:
    others = [
        str(path.relative_to(ROOT))
        for folder in ("dpm2_core", "dpm2_ros")
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"\brich\.table\b", path.read_text())
    ]
    # the fleet's view shows the progress of drives: bars, no figures
    assert sorted(others) == ["dpm2_core/fleet/view.py", "dpm2_core/tables.py"]


def test_a_figure_that_is_not_there_is_a_dash() -> None:
    """This includes a field of a missing object; zero and text are figures."""
    record = {"loops": {"tried": 0, "of two rooms": "no"}, "ape_m": None, "metrics": None}
    columns = ("{loops[tried]} of {loops[of two rooms]}", "{ape_m:.3f}", "{metrics[rpe_m]:.1f}", "{seconds:.0f} s")
    assert cells_of(record, columns) == ["0 of no", "-", "-", "- s"]
