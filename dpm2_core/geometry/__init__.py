# SPDX-License-Identifier: Apache-2.0
"""Rigid motions, rays and point sampling; knows nothing of the rest of the package."""
