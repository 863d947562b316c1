# SPDX-License-Identifier: Apache-2.0
"""Reading drives: KITTI folders and ROS bags, both as a `Source` of frames."""
