# SPDX-License-Identifier: Apache-2.0
"""Interrupt a training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from dpm2_core.learning import trainer


def stopped(train: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> None:
    """Train until Ctrl-C, which is raised right after the first checkpoint."""
    save = trainer.save_checkpoint

    def save_and_stop(*arguments: Any) -> None:
        save(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(trainer, "save_checkpoint", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            train()
