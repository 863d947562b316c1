# SPDX-License-Identifier: Apache-2.0
"""Opening any kind of recording, and reading ahead."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dpm2_core.config import settings_from
from dpm2_core.data.bags import BagSource
from dpm2_core.data.kitti import KittiSource
from dpm2_core.data.open import open_source
from dpm2_core.data.prefetch import prefetch
from dpm2_core.data.settings import InputSettings
from dpm2_core.data.source import parse_range
from dpm2_core.errors import UsageError


def test_the_kind_is_guessed(kitti_folder: Callable[..., Path], bags, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    folder = kitti_folder()
    assert isinstance(open_source(folder), KittiSource)
    assert isinstance(open_source(str(folder.parents[1])), KittiSource)
    for plugin, suffix in (("MCAP", "mcap"), ("SQLITE3", "db3")):
        bag = bags.write(tmp_path / plugin, [(1, "/points", bags.cloud(1))], plugin)
        assert isinstance(open_source(bag), BagSource)
        assert isinstance(open_source(bag / f"{plugin}.{suffix}"), BagSource)


def test_what_is_no_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"absent: no such file or folder"):
        open_source(tmp_path / "absent")
    with pytest.raises(UsageError, match="no KITTI sequence"):
        open_source(tmp_path)
    (tmp_path / "old.bag").touch()
    with pytest.raises(UsageError, match=r"old\.bag: cannot be read as a ROS 1 bag: .* seems to be empty"):
        open_source(tmp_path / "old.bag")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(UsageError, match=r"notes.txt: cannot be read as a bag"):
        open_source(tmp_path / "notes.txt")


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"time_unit": "min"}, "time_unit"),
        ({"image_tolerance": 0}, "image_tolerance"),
        ({"T_lidar_cam": [1, 2, 3]}, "T_lidar_cam"),
        ({"T_lidar_cam": [1, 2, 3, 0, 0, 0, 0]}, "T_lidar_cam: .*no unit quaternion"),
        ({"vertical_angle_correction_deg": "off"}, "vertical_angle_correction_deg"),
    ],
)
def test_settings_out_of_range_are_named(tree: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        settings_from(InputSettings, tree)


def test_prefetch_keeps_order_and_reads_ahead() -> None:
    read: list[int] = []

    def items() -> Iterator[int]:
        for i in range(10):
            read.append(i)
            yield i

    ahead = prefetch(items(), depth=2)
    assert next(ahead) == 0
    deadline = time.monotonic() + 60
    while len(read) < 4 and time.monotonic() < deadline:  # one returned, two queued, one waiting
        time.sleep(0.01)
    assert read == [0, 1, 2, 3]
    assert list(ahead) == list(range(1, 10))


def test_prefetch_raises_what_the_reader_raised_after_the_items_before() -> None:
    def items() -> Iterator[int]:
        yield 1
        raise UsageError("broken")

    ahead = prefetch(items())
    assert next(ahead) == 1
    with pytest.raises(UsageError, match="broken"):
        next(ahead)


def test_closing_prefetch_ends_its_thread() -> None:
    ahead = prefetch(iter(range(1000)), depth=1)
    next(ahead)
    assert any(thread.name.startswith("prefetch") for thread in threading.enumerate())
    ahead.close()  # type: ignore[attr-defined]
    assert not any(thread.name.startswith("prefetch") for thread in threading.enumerate())


@pytest.mark.parametrize("text", ["10:5", "3:3", ":0"])
def test_an_empty_range_is_said_to_be_one(text: str) -> None:
    """Previously, the error stated the number of frames, which is sufficient."""
    with pytest.raises(UsageError, match=f"--frames {text}: want a before b in a:b"):
        parse_range(text)


def test_a_range_is_open_where_nothing_is_said() -> None:
    assert [parse_range(text) for text in (":", "5:", ":7", "5:7")] == [(0, None), (5, None), (0, 7), (5, 7)]
