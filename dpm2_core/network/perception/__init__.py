# SPDX-License-Identifier: Apache-2.0
"""Small networks that find ground, dynamic objects or static structure in a scan; the SLAM may filter with them."""
