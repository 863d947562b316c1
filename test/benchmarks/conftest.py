# SPDX-License-Identifier: Apache-2.0
"""Scans, images and a small network, as the core's tests have them."""

from __future__ import annotations

from ..dpm2_core.conftest import _make_image, _street, model, noise  # noqa: F401
