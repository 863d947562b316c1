# SPDX-License-Identifier: Apache-2.0
"""A table of a paper: our rows next to its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from dpm2_core.tables import FigureTable, cells_of

MEAN = "mean"
"""Name of the last column: the arithmetic mean of the others, as in the papers."""

Cells = dict[str, dict[str, float | None]]
"""Figures by column."""


@dataclass(frozen=True)
class Row:
    """One method: its name, the origin of its figures ("this run", or the paper), and the figures."""

    name: str
    origin: str
    cells: Cells
    note: str = ""


@dataclass
class ResultTable:
    """Rows of figures by column.

    Attributes:
        figures: name of each figure and how it is printed, such as ".2f".
        caption: how the figures are defined.
    """

    title: str
    columns: Sequence[str]
    figures: Mapping[str, str]
    caption: str = ""
    rows: list[Row] = field(default_factory=list)

    def add(self, name: str, cells: Cells, origin: str = "this run", note: str = "") -> None:
        """Add a row, with the table's columns. If the table has a column `MEAN` and the row does not, the mean of each
        figure is added that every column has."""
        cells = {column: cells[column] for column in self.columns if column in cells}
        data_columns = [column for column in self.columns if column != MEAN]
        if MEAN in self.columns and MEAN not in cells:
            cells = {**cells, MEAN: {figure: _mean(cells, data_columns, figure) for figure in self.figures}}
        self.rows.append(Row(name, origin, cells, note))

    def record(self) -> dict[str, Any]:
        """The table for JSON, with the cells of each row also as text; see `shown`."""
        rows = [{**asdict(row), "texts": [self._text(row, column) for column in self.columns]} for row in self.rows]
        return {"title": self.title, "columns": list(self.columns), "caption": self.caption, "rows": rows}

    def _text(self, row: Row, column: str) -> str:
        """The figures of a column with slashes between, "-" for missing ones."""
        cells = cells_of(row.cells.get(column, {}), (f"{{{name}:{form}}}" for name, form in self.figures.items()))
        return "-" if set(cells) == {"-"} else " / ".join(cells)


def _mean(cells: Cells, columns: Sequence[str], figure: str) -> float | None:
    values = [cells.get(column, {}).get(figure) for column in columns]
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def shown(record: Mapping[str, Any], where: str = "") -> FigureTable:
    """A table that `ResultTable.record` has written, to print; `where`: put before its title.

    Raises:
        KeyError, TypeError, ValueError: the record is not of a table.
    """
    notes = ["note"] if any(row["note"] for row in record["rows"]) else []
    title, caption = f"{where}{record['title']}", str(record["caption"])
    table = FigureTable(title, names=["method", "figures of"], figures=record["columns"], text=notes, caption=caption)
    for row in record["rows"]:
        table.add_row(*map(str, (row["name"], row["origin"], *row["texts"], *(row[name] for name in notes))))
    return table
