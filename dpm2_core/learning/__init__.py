# SPDX-License-Identifier: Apache-2.0
"""Training of the network: registration, overlap, image branch, and fine-tuning on a user's drives."""
