# SPDX-License-Identifier: Apache-2.0
"""Reads numbers and times from text files, with errors that name file and line."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dpm2_core.errors import UsageError
from dpm2_core.files import is_stream
from dpm2_core.frame import Array

MAX_NUMBER = 9e9
"""s, of a stamp in ns as an integer: the year 2255; no position or focal length is as large."""
_DATE = re.compile(r"(?:.*\D)?(\d{4})\D?([01]\d)\D?([0-3]\d)\D([0-2]\d)\D?([0-5]\d)\D?([0-5]\d)(?:\D(\d{1,9}))?")


def read_numbers(path: Path, columns: int) -> Array:
    """(lines, columns) float64 of a text file without its lines that begin with #; no rows if the file is missing.

    Raises:
        UsageError: a line has another count of numbers, or other text; the message names the line.
    """
    rows = [
        parse_row(line, columns, f"{path}:{i}")
        for i, line in enumerate(read_lines(path), 1)
        if line.strip() and not line.startswith("#")
    ]
    return np.array(rows).reshape(-1, columns)


def read_keyed(path: Path) -> dict[str, Array]:
    """The `name: numbers` lines of a calibration file, as float64 of any length; other lines are skipped.

    Raises:
        UsageError: there is no such file.
    """
    found: dict[str, Array] = {}
    if not path.is_file():
        raise UsageError(f"{path}: no such file, and the calibration is needed")
    for number, line in enumerate(read_lines(path), 1):
        name, colon, text = line.partition(":")
        words = text.split()
        try:
            values = [float(word) for word in words]
        except ValueError:
            continue  # such as dates
        if colon and values:
            found[name.strip()] = parse_row(text, len(words), f"{path}:{number}: {name}")
    return found


def required(rows: dict[str, Array], name: str, count: int, path: Path) -> Array:
    """(count,) numbers stored under a name in a file that was read by `read_keyed`.

    Raises:
        UsageError: they are missing, or there are more or fewer.
    """
    row = rows.get(name)
    if row is None or len(row) != count:
        raise UsageError(f"{path}: no {name} of {count} numbers")
    return row


def read_lines(path: Path, missing_ok: bool = True) -> list[str]:
    """Lines of a text file; for a missing file an empty list, or an error. With `missing_ok` it belongs to a data set,
    and may be no pipe or device."""
    if missing_ok and is_stream(path):
        raise UsageError(f"{path}: not a file")
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        if missing_ok and isinstance(error, FileNotFoundError):
            return []
        raise UsageError(f"{path}: {getattr(error, 'strerror', None) or 'not a text file'}") from None


def parse_row(text: str, count: int, where: str) -> Array:
    """(count,) finite numbers of a line, none beyond 9e9; for any other line a UsageError that begins with `where`."""
    try:
        row = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise UsageError(f"{where}: {error}") from None
    if len(row) != count or not np.isfinite(row).all():
        raise UsageError(f"{where}: {len(row)} numbers, want {count} finite ones")
    if np.abs(row).max(initial=0) > MAX_NUMBER:
        raise UsageError(f"{where}: {np.abs(row).max():g} is too large for a time, position or calibration")
    return row


def date_ns(text: str) -> int | None:
    """ns since 1970 of a text that ends in a UTC date, such as 2023-11-14_22-13-20_750 or 20231114_221320.750; None for
    other texts and for dates that do not exist."""
    if (match := _DATE.fullmatch(text)) is None:
        return None
    year, month, day, hour, minute, second = (int(match[i]) for i in range(1, 7))
    try:
        seconds = datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except ValueError:
        return None
    return int(seconds) * 10**9 + int((match[7] or "0").ljust(9, "0"))
