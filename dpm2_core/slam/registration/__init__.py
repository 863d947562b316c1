# SPDX-License-Identifier: Apache-2.0
"""Scan registration: by points, by neural descriptors, by both, and with the camera."""
