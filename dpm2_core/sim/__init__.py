# SPDX-License-Identifier: Apache-2.0
"""The synthetic city: ray-cast scans and images of random worlds, with exact poses, labels and static twins."""
