# SPDX-License-Identifier: Apache-2.0
"""Many drives: each is a part of a whole that is done once, on this machine or on a cluster of Ray."""
