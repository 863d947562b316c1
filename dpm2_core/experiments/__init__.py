# SPDX-License-Identifier: Apache-2.0
"""Tables and figures of the papers, as commands that can be repeated."""
