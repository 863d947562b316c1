# SPDX-License-Identifier: Apache-2.0
"""Packed drives to train on, as those of the learning tests."""

from __future__ import annotations

from ..learning.conftest import packed, samples  # noqa: F401
