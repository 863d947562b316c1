# SPDX-License-Identifier: Apache-2.0
"""The synthetic city: ray-cast LiDAR scans and camera images of random worlds, with exact poses, labels and static twins."""
