# SPDX-License-Identifier: Apache-2.0
"""Tools of this repository, not installed: demo and replay."""
