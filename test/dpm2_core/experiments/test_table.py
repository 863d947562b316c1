# SPDX-License-Identifier: Apache-2.0
"""A paper's table with our rows next to its own."""

from __future__ import annotations

from dpm2_core.experiments.table import MEAN, ResultTable


def test_a_mean_is_of_all_columns_or_there_is_none() -> None:
    """A mean over only the available sequences would compare different drives."""
    table = ResultTable("t", ["06", "07", MEAN], {"a": ".1f", "b": ".2f"})
    table.add("ours", {"06": {"a": 1.0, "b": None}, "07": {"a": 2.0, "b": 1.0}})
    table.add("theirs", {"06": {"a": 1.0}}, "the paper")
    rows = table.record()["rows"]
    assert [row["texts"] for row in rows] == [["1.0 / -", "2.0 / 1.00", "1.5 / -"], ["1.0 / -", "-", "-"]]
    assert rows[1]["origin"] == "the paper"
