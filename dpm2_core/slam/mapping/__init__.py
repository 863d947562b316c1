# SPDX-License-Identifier: Apache-2.0
"""The map: keyframes, their store on disk, maintenance and exports."""
