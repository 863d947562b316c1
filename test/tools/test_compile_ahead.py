# SPDX-License-Identifier: Apache-2.0
"""The modules whose loops `make setup` compiles."""

from __future__ import annotations

from tools.compile_ahead import compile_module, compiled_modules


def test_every_module_with_compiled_loops_is_found_and_can_be_imported() -> None:
    modules = compiled_modules()
    assert {"dpm2_core.geometry.point_grid", "dpm2_core.network.consensus"} <= set(modules)
    assert "dpm2_core.geometry.compiled" not in modules, "it defines the decorator, and has no loop"
    for name in modules:
        compile_module(name)
