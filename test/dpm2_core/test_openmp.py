# SPDX-License-Identifier: Apache-2.0
"""torch is never set to more threads than OpenMP allows."""

from __future__ import annotations

import pytest

from dpm2_core.openmp import allowed


@pytest.mark.parametrize(
    ("limit", "threads"), [(None, 4), ("", 4), ("2", 2), ("8", 4), ("0", 4), ("-1", 4), ("many", 4)]
)
def test_the_limit_of_openmp_holds(monkeypatch: pytest.MonkeyPatch, limit: str | None, threads: int) -> None:
    """An invalid number of threads is ignored, as OpenMP does."""
    monkeypatch.delenv("OMP_THREAD_LIMIT", raising=False)
    if limit is not None:
        monkeypatch.setenv("OMP_THREAD_LIMIT", limit)
    assert allowed(4) == threads
