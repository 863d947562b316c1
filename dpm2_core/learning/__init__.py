# SPDX-License-Identifier: Apache-2.0
"""Training of the network: phase one (registration) and phase two (overlap)."""
