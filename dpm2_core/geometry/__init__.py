# SPDX-License-Identifier: Apache-2.0
"""Rigid motions, rays, point sampling, and properties of a scan's shape; depends only on frames."""
