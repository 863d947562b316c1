# SPDX-License-Identifier: Apache-2.0
"""How good a trajectory or a registration is: error metrics, figures, and records of results."""
