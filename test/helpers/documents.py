# SPDX-License-Identifier: Apache-2.0
"""Text of the documents, and the records in benchmarks/ that it is compared with."""

from __future__ import annotations

import json
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def record(name: str) -> Any:
    """Contents of a JSON file in benchmarks/."""
    return json.loads((ROOT / "benchmarks" / name).read_text(encoding="utf-8"))


def text(path: str) -> str:
    """Text of a document in one line."""
    return " ".join((ROOT / path).read_text(encoding="utf-8").split())


def rows(path: str, heading: str) -> Iterator[list[str]]:
    """Cells of the table in a Markdown file that begins with this heading."""
    lines = iter((ROOT / path).read_text(encoding="utf-8").splitlines())
    assert any(line == heading for line in lines), f"{path}: no table {heading}"
    next(lines)
    for line in lines:
        if not line.startswith("|"):
            return
        yield [cell.strip() for cell in line.strip("|").split("|")]


def equals(written: str, true: float) -> bool:
    """Whether a figure in a text is the true one, rounded to the same number of digits."""
    digits = -int(Decimal(written).as_tuple().exponent)
    return abs(float(written) - true) <= 0.5001 * 10.0**-digits
