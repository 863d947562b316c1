# SPDX-License-Identifier: Apache-2.0
"""The SLAM itself: synchronous and deterministic; `system.py` is the whole algorithm."""
