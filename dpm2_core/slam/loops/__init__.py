# SPDX-License-Identifier: Apache-2.0
"""Loop closing and relocalization: retrieval, registration, verification, consistency."""
