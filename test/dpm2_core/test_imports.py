# SPDX-License-Identifier: Apache-2.0
"""Garbage collection is off during large imports, and afterwards as it was."""

from __future__ import annotations

import gc

import pytest

from dpm2_core.imports import importing


def test_afterwards_it_is_as_before() -> None:
    with importing():
        assert not gc.isenabled()
        with importing():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ModuleNotFoundError), importing():
        import no_such_module  # noqa: F401
    assert gc.isenabled()
