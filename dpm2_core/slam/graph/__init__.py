# SPDX-License-Identifier: Apache-2.0
"""The pose graph: robust optimization, a worker process, g2o."""
