# SPDX-License-Identifier: Apache-2.0
"""The pose graph: robust optimisation, a worker process, g2o."""
