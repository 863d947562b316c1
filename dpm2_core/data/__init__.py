# SPDX-License-Identifier: Apache-2.0
"""Reading drives: data set folders and ROS bags, each as a `Source` of frames."""
