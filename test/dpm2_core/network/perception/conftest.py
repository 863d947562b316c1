# SPDX-License-Identifier: Apache-2.0
"""The networks' tests run on one thread, as those of the tasks do."""

from __future__ import annotations

from ...tasks.conftest import one_thread  # noqa: F401
