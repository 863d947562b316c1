# SPDX-License-Identifier: Apache-2.0
"""Frees shared memory of killed processes: Fast DDS frees its own at the end, but not that of other processes.

With dpm2's profile each segment has 35 MB. On a robot whose node is killed and restarted again and again, they would
fill the memory.
"""

from __future__ import annotations

import fcntl
import re
import time
from pathlib import Path

_SEGMENT_NAME = re.compile(r"fastrtps_[0-9a-f]{16}")  # not the ports, which Fast DDS itself takes over
_MIN_AGE = 60.0  # s; Fast DDS makes a lock file first, and locks it then


def free_shared_memory(folder: Path = Path("/dev/shm")) -> None:
    """Remove the segments of Fast DDS whose process has ended, as `fastdds shm clean` does.

    A running process holds the lock on the file `NAME_el` next to its segment. Files that cannot be opened, such as
    those of other users, are not removed.
    """
    for lock in folder.glob("fastrtps_*_el"):
        segment = lock.with_name(lock.name.removesuffix("_el"))
        if not _SEGMENT_NAME.fullmatch(segment.name):
            continue
        try:
            if time.time() - lock.stat().st_mtime < _MIN_AGE:
                continue
            with lock.open("r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                segment.unlink(missing_ok=True)
                lock.unlink(missing_ok=True)
        except OSError:
            continue  # locked, or of another user
