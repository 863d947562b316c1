# SPDX-License-Identifier: Apache-2.0
"""The version of dpm2, which setup.py reads; package.xml and CITATION.cff repeat it, and a test compares them."""

__version__ = "0.1.0"
