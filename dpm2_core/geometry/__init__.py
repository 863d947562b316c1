# SPDX-License-Identifier: Apache-2.0
"""Rigid motions, rays, point sampling, and what the shape of a scan shows; depends only on frames."""
