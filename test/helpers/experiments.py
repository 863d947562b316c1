# SPDX-License-Identifier: Apache-2.0
"""Output of an experiment."""

from __future__ import annotations

import json
from pathlib import Path


def first_table(path: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Cells of the first table of an experiment's JSON."""
    return {row["name"]: row["cells"] for row in json.loads(path.read_text())["tables"][0]["rows"]}
