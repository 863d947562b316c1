# SPDX-License-Identifier: Apache-2.0
"""Shared memory that killed processes have left: Fast DDS frees its own at the end, but not that of others.

With our profile each is 35 MB. A robot whose node is killed and started again, over and over, would fill its memory.
"""

from __future__ import annotations

import fcntl
import re
import time
from pathlib import Path

_SEGMENT = re.compile(r"fastrtps_[0-9a-f]{16}")  # not the ports, which Fast DDS itself takes over
_YOUNG = 60.0  # s; Fast DDS makes a lock file first, and locks it then


def free_shared_memory(folder: Path = Path("/dev/shm")) -> None:
    """Remove the segments of Fast DDS whose process is gone, as `fastdds shm clean` does.

    A process holds the lock on the file `NAME_el` beside its segment as long as it lives. What may not be opened,
    such as files of other users, stays.
    """
    for lock in folder.glob("fastrtps_*_el"):
        segment = lock.with_name(lock.name.removesuffix("_el"))
        if not _SEGMENT.fullmatch(segment.name):
            continue
        try:
            if time.time() - lock.stat().st_mtime < _YOUNG:
                continue
            with lock.open("r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                segment.unlink(missing_ok=True)
                lock.unlink(missing_ok=True)
        except OSError:
            continue  # held, or another's
