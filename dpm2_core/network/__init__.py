# SPDX-License-Identifier: Apache-2.0
"""The DeepPointMap2 network: a frame becomes a few hundred descriptors, two sets of descriptors become a pose."""
