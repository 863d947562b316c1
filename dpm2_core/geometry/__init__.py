# SPDX-License-Identifier: Apache-2.0
"""Rigid motions, rays and point sampling; imports nothing of the rest of the package."""
