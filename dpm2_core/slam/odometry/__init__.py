# SPDX-License-Identifier: Apache-2.0
"""Odometry from frame to frame, and the selection of keyframes."""
