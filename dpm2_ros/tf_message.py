# SPDX-License-Identifier: Apache-2.0
"""The message type of /tf, if tf2_msgs is available: it is part of every ROS installation, and
`dpm2_ros.build_tf2_msgs` builds it for ROS from pip. In its own module: bag_player needs nothing else of `dpm2_ros.tf`.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

TFMessage: Any = None
with suppress(ImportError):
    from tf2_msgs.msg import TFMessage as TFMessage  # type: ignore[no-redef]

MAX_TRANSFORMS = 500
"""Largest number of transforms in a message that is read."""
