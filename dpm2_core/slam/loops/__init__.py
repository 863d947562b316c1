# SPDX-License-Identifier: Apache-2.0
"""Places found again: retrieval, registration, verification, consistency, relocalization."""
