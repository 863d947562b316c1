# SPDX-License-Identifier: Apache-2.0
"""The paper's ways put into ours: every one changes the settings, and together they are the preset."""

from __future__ import annotations

from benchmarks.paper import WAYS
from dpm2_core.config import load_settings
from dpm2_core.slam.settings import Config


def test_each_way_is_a_part_of_the_preset() -> None:
    ours, paper = (load_settings(Config, None, WAYS[name]).slam.model_dump() for name in ("ours", "the paper's"))
    changed = set()
    for name in set(WAYS) - {"the paper's"}:
        one = load_settings(Config, None, WAYS[name]).slam.model_dump()
        for part, values in one.items():
            for key, value in values.items() if isinstance(values, dict) else ():
                if value != ours[part][key]:
                    changed.add((part, key))
                    assert value == paper[part][key], (name, part, key)
    differing = {
        (part, key) for part, values in paper.items() if isinstance(values, dict)
        for key, value in values.items() if value != ours[part][key]
    }  # fmt: skip
    assert changed == differing
