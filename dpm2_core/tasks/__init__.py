# SPDX-License-Identifier: Apache-2.0
"""Perception tasks that the SLAM loss is tried on."""
