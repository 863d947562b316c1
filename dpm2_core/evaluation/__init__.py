# SPDX-License-Identifier: Apache-2.0
"""How good a trajectory is: file formats, error metrics, figures and the benchmark harness."""
