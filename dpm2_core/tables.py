# SPDX-License-Identifier: Apache-2.0
"""Tables for people, which lose nothing on a narrow terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from string import Formatter
from typing import Any

from rich.box import SIMPLE
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from dpm2_core.console import lines

_MIN_TEXT_WIDTH = 24
"""Characters per line that text needs to be read with ease."""


class FigureTable:
    """Columns of names, figures and text, in this order. A table that is too wide for the terminal is transposed.

    Text is wrapped, names and figures are not, and nothing is cut. In a transposed table a row is a column, with as
    many rows of a section next to each other as fit. Cells are printed as they are: text that looks like rich's markup
    comes from a file or a topic.

    Attributes:
        title, caption: texts above and below. headings: of the columns. rows: of cells.
    """

    def __init__(
        self,
        title: str,
        *,
        names: Sequence[str] = (),
        figures: Sequence[str] = (),
        text: Sequence[str] = (),
        caption: str = "",
        header: bool = True,
    ) -> None:
        """Headings of the columns of each kind; with `header` False they are not shown."""
        self.title, self.caption, self._header = lines(title), caption, header
        self.headings = [*names, *figures, *text]
        self._text = len(names) + len(figures)  # the first column of text
        self._names = len(names)
        self.rows: list[list[str]] = []
        self._sections: set[int] = set()

    def add_row(self, *cells: str) -> None:
        """Add a row with a cell for each column.

        Raises:
            ValueError: more or fewer cells than columns.
        """
        if len(cells) != len(self.headings):
            raise ValueError(f"{len(cells)} cells for {len(self.headings)} columns")
        self.rows.append([lines(cell) for cell in cells])

    def add_section(self) -> None:
        """Add a gap after the last row."""
        self._sections.add(len(self.rows))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.title, style="italic")
        columns = [*zip(self.headings, *self.rows, strict=True)]
        widths = [max(map(cell_len, column if self._header else column[1:]), default=0) for column in columns]
        min_widths = [*widths[: self._text], *(min(width, _MIN_TEXT_WIDTH) for width in widths[self._text :])]
        if _total_width(min_widths) <= options.max_width or not self.rows:
            yield self._plain_table()
        else:
            yield from self._transposed_tables(options.max_width)
        if self.caption:
            yield Text(self.caption, style="dim italic")

    def _plain_table(self) -> Table:
        table = Table(box=SIMPLE, show_header=self._header)
        for number, heading in enumerate(self.headings):
            figure = self._names <= number < self._text
            prose = number >= self._text
            table.add_column(Text(heading), justify="right" if figure else "left", no_wrap=not prose, overflow="fold")
        for number, row in enumerate(self.rows, 1):
            table.add_row(*map(Text, row), end_section=number in self._sections)
        return table

    def _transposed_tables(self, width: int) -> Iterator[Table]:
        label = max(map(cell_len, self.headings))
        first = 0
        while first < len(self.rows):
            last = first + 1
            while last < len(self.rows) and last not in self._sections:
                if _total_width([label, *(max(map(cell_len, row)) for row in self.rows[first : last + 1])]) > width:
                    break
                last += 1
            table = Table(box=SIMPLE, show_header=False)
            table.add_column(no_wrap=True)
            for _ in range(first, last):
                table.add_column(justify="right", overflow="fold")
            for number, heading in enumerate(self.headings):
                cells = (Text(row[number]) for row in self.rows[first:last])
                table.add_row(Text(heading, style="bold"), *cells, end_section=number == self._names - 1)
            yield table
            first = last


class _FigureFormatter(Formatter):
    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        try:
            return super().get_field(field_name, args, kwargs)
        except (KeyError, TypeError):
            return None, field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        return "-" if value is None else format(value, format_spec)


def cells_of(record: Mapping[str, Any], columns: Iterable[str]) -> list[str]:
    """Figures of a nested record as text, by columns such as "{loops[accepted]} of {loops[tried]}" or "{ape_m:.3f}";
    "-" for a missing or null value."""
    return [_FigureFormatter().vformat(column, (), record) for column in columns]


def record_table(
    title: str, names: Sequence[str], columns: Mapping[str, str], record: Mapping[str, Any], sections: bool = False
) -> FigureTable:
    """A table of a nested record; `names` are the headings of its keys, from the outermost on.

    Args:
        columns: headings of the figures, and their formats, see `cells_of`. sections: a gap after each of the
            outermost keys.
    """
    table = FigureTable(title, names=names, figures=list(columns))
    for first, entries in record.items():
        for path, row in _leaves(entries, len(names) - 1):
            table.add_row(first, *path, *cells_of(row, columns.values()))
        if sections:
            table.add_section()
    return table


def _leaves(record: Any, depth: int) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Keys and value of every entry at this depth of a nested record."""
    if not depth:
        yield (), record
        return
    for key, entry in record.items():
        yield from (((key, *path), value) for path, value in _leaves(entry, depth - 1))


def _total_width(widths: Sequence[int]) -> int:
    """Width of a table with such columns: a blank on either side of each, and one between, before and after them."""
    return sum(widths) + 3 * len(widths) + 1
