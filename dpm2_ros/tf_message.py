# SPDX-License-Identifier: Apache-2.0
"""The message of /tf, where tf2_msgs is there: part of every ROS installation, built by `dpm2_ros.build_tf2_msgs` for
ROS from pip. Apart: the player of bags needs nothing else of `dpm2_ros.tf`."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

TFMessage: Any = None
with suppress(ImportError):
    from tf2_msgs.msg import TFMessage as TFMessage  # type: ignore[no-redef]

MOST_TRANSFORMS = 500
"""In a message that is read."""
