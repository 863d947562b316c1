# SPDX-License-Identifier: Apache-2.0
"""Short drives through the synthetic city, with exact ground truth."""

from __future__ import annotations

import pytest

from ...helpers.drives import Drive, make_drive


@pytest.fixture(scope="session")
def suburb_drive() -> Drive:
    """30 frames."""
    return make_drive("suburb", 30)


@pytest.fixture(scope="session")
def tunnel_drive() -> Drive:
    """12 frames."""
    return make_drive("tunnel", 12)
