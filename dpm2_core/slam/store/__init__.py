# SPDX-License-Identifier: Apache-2.0
"""The map file: schema, rows, reading, writing and repair."""
