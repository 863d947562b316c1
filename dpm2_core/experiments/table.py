# SPDX-License-Identifier: Apache-2.0
"""A table of a paper: our rows beside its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dpm2_core.evaluation.run_page import HtmlTable
from dpm2_core.tables import FigureTable

MEAN = "mean"
"""Name of the last column: the arithmetic mean of the others, as the papers take it."""

Cells = dict[str, dict[str, float | None]]
"""Figures by column."""


@dataclass(frozen=True)
class Row:
    """One method: what it is called, where its figures come from ("this run", or the paper), and the figures."""

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
        """A row; a mean is added where every column has a figure and there are several, and the row brings none."""
        given = [column for column in self.columns if column != MEAN]
        if MEAN in self.columns and MEAN not in cells:
            cells = {**cells, MEAN: {figure: _mean(cells, given, figure) for figure in self.figures}}
        self.rows.append(Row(name, origin, cells, note))

    def value(self, row: Row, column: str, figure: str) -> float | None:
        """A figure; None where there is none."""
        return row.cells.get(column, {}).get(figure)

    def record(self) -> dict[str, Any]:
        """For JSON."""
        rows = [
            {"name": r.name, "origin": r.origin, "note": r.note, "cells": r.cells, "texts": texts}
            for r, texts in self.texts()
        ]
        return {"title": self.title, "columns": list(self.columns), "caption": self.caption, "rows": rows}

    def texts(self) -> list[tuple[Row, list[str]]]:
        """Each row with its cells as text: the figures of a column with slashes between, "-" for what is not there."""
        return [(row, [self._text(row, column) for column in self.columns]) for row in self.rows]

    def view(self) -> FigureTable:
        """For the terminal."""
        notes = ["note"] if any(row.note for row in self.rows) else []
        table = FigureTable(
            self.title, names=["method", "figures of"], figures=list(self.columns), text=notes, caption=self.caption
        )
        for row, cells in self.texts():
            table.add_row(row.name, row.origin, *cells, *([row.note] if notes else []))
        return table

    def _text(self, row: Row, column: str) -> str:
        values = [self.value(row, column, figure) for figure in self.figures]
        if all(value is None for value in values):
            return "-"
        shown = zip(values, self.figures.values(), strict=True)
        return " / ".join("-" if value is None else format(value, form) for value, form in shown)


def _mean(cells: Cells, columns: Sequence[str], figure: str) -> float | None:
    values = [cells.get(column, {}).get(figure) for column in columns]
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if there and len(there) == len(values) else None


def html_table(record: Mapping[str, Any]) -> HtmlTable:
    """A table that `ResultTable.record` has written, for a page.

    Raises:
        KeyError, TypeError: it is none.
    """
    headings = ["method", "figures of", *record["columns"], "note"]
    rows = [[row["name"], row["origin"], *row["texts"], row["note"]] for row in record["rows"]]
    return HtmlTable(record["title"], headings, rows, record["caption"])
