# SPDX-License-Identifier: Apache-2.0
"""Every kind of damage to the files of a bag."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backports import zstd

from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.open import open_source
from dpm2_core.errors import UsageError
from test.helpers.recordings import POINTS, clouds

# --- damaged files


@pytest.fixture
def recording(bags: Any, tmp_path: Path) -> Path:
    """100 clouds of 1000 points, about 16 kB each."""
    messages = [(1 + 0.1 * i, POINTS, bags.cloud(1 + 0.1 * i, i, count=1000)) for i in range(100)]
    return bags.write(tmp_path / "rec", messages)


def mcap(recording: Path) -> Path:
    return recording / f"{recording.name}.mcap"


@pytest.mark.parametrize("bare", [False, True])
def test_a_truncated_mcap_gives_what_is_whole(recording: Path, bare: bool) -> None:
    whole = mcap(recording).read_bytes()
    mcap(recording).write_bytes(whole[: int(0.9 * len(whole))])
    source = BagSource(mcap(recording) if bare else recording)
    frames = list(source.frames())
    assert 60 <= len(frames) == len(source) < 100  # a chunk contains 65 of them
    assert [frame.points[0, 0] for frame in frames] == list(range(len(frames)))
    assert all(frame.problem is None and len(frame.points) == 1000 for frame in frames)
    assert f"truncated or never closed (File end magic is invalid.); {len(frames)} messages" in source.notes[0]


def test_every_cut_is_survived(bags: Any, tmp_path: Path) -> None:
    """Wherever a small file is cut, the result is all three frames, or one clear error."""
    bag = bags.write(tmp_path / "b", clouds(bags, [1, 2, 3]))
    whole, rejected = mcap(bag).read_bytes(), []
    for size in range(0, len(whole), 97):
        mcap(bag).write_bytes(whole[:size])
        try:
            frames = list(BagSource(bag).frames())
        except UsageError as error:
            rejected.append(str(error))
            continue
        assert len(frames) == 3
        assert all(frame.problem is None for frame in frames)
    assert rejected
    assert all(re.search("file is empty|wrong magic|truncated before", reason) for reason in rejected)


@pytest.mark.parametrize("bare", [False, True])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"garbage " * 1000, r"is no MCAP file \(wrong magic bytes\)"),
        (b"\x89MCAP0\r\n", "truncated before its first message"),
        (b"\x89MCAP0\r\n" * 20, "truncated before its first message"),
    ],
)
def test_files_without_anything_to_read(recording: Path, bare: bool, content: bytes, message: str) -> None:
    mcap(recording).write_bytes(content)
    with pytest.raises(UsageError, match=message):
        BagSource(mcap(recording) if bare else recording)


@pytest.mark.parametrize("text", [None, "", "rosbag2_bagfile_information: [", "a: 1"])
def test_without_usable_metadata_the_files_are_read(recording: Path, text: str | None) -> None:
    (recording / "metadata.yaml").unlink()
    if text is not None:
        (recording / "metadata.yaml").write_text(text)
    source = BagSource(recording)
    assert len(list(source.frames())) == 100
    assert ("no metadata.yaml" if text is None else "metadata.yaml is unusable") in source.notes[0]


def test_metadata_without_its_file(recording: Path) -> None:
    mcap(recording).unlink()
    with pytest.raises(UsageError, match=r"no \.mcap or \.db3 file in this folder"):
        BagSource(recording)


@pytest.mark.parametrize("keep", [0, 100, 5000])
def test_a_damaged_sqlite_bag_is_named(bags: Any, tmp_path: Path, keep: int) -> None:
    bag = bags.write(tmp_path / "b", clouds(bags, [1, 2, 3]), "SQLITE3")
    file = bag / "b.db3"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(UsageError, match=r"b\.db3: (the file is empty|cannot be read as a bag)"):
        BagSource(bag)


def test_bytes_overwritten_in_the_middle_never_crash(recording: Path) -> None:
    """Within a cloud they change points, elsewhere a record. The result is frames, failed frames, or an end that the
    notes explain."""
    whole, rng = mcap(recording).read_bytes(), np.random.default_rng(0)
    for place in rng.integers(1000, len(whole) - 6000, 12):
        mcap(recording).write_bytes(whole[:place] + rng.bytes(200) + whole[place + 200 :])
        source = BagSource(recording)
        count = len(list(source.frames()))
        assert count == 100 or any("damaged after" in note for note in source.notes)


def test_a_damaged_chunk_ends_the_drive_and_says_so(bags: Any, tmp_path: Path) -> None:
    """A compressed chunk cannot be read at all once a byte of it is wrong."""
    messages = [(1 + 0.1 * i, POINTS, bags.cloud(1 + 0.1 * i, i, count=1000)) for i in range(100)]
    bag = bags.write(tmp_path / "b", messages, zstd=True)
    whole = mcap(bag).read_bytes()
    second = whole.index(b"\x28\xb5\x2f\xfd", whole.index(b"\x28\xb5\x2f\xfd") + 4)  # start of a zstd frame
    mcap(bag).write_bytes(whole[:second] + bytes(20) + whole[second + 20 :])
    source = BagSource(bag)
    frames = list(source.frames())
    assert [frame.points[0, 0] for frame in frames] == list(range(len(frames)))
    assert 0 < len(frames) < len(source) == 100
    assert any(f"damaged after {len(frames)} messages of /points" in note for note in source.notes)


# --- split recordings


def split(bags: Any, folder: Path, plugin: str = "MCAP", compressed: bool = False) -> list[Path]:
    """Twelve files of two clouds each, with numbers without leading zeros, and no metadata.yaml."""
    folder.mkdir()
    for n in range(12):
        times = [1 + 0.2 * n, 1.1 + 0.2 * n]
        messages = [(t, POINTS, bags.cloud(t, x=2.0 * n + i)) for i, t in enumerate(times)]
        part = bags.write(folder.with_name(f"part_{n}"), messages, plugin, zstd=compressed)
        (file,) = (file for file in part.iterdir() if file.suffix != ".yaml")
        file.rename(folder / f"drive_{n}{file.suffix}")
    return sorted(folder.iterdir(), key=lambda file: int(file.stem.removeprefix("drive_")))


@pytest.mark.parametrize(
    ("plugin", "keep", "count", "note"),
    [
        ("MCAP", 0.99, 24, r"drive_11\.mcap: truncated or never closed \(.*\); 2 messages of it could be saved"),
        ("MCAP", 0.1, 22, r"drive_11\.mcap: truncated before its first message \(.*\); read without it"),
        ("MCAP", 0, 22, r"drive_11\.mcap: the file is empty; read without it"),
        ("SQLITE3", 0.5, 22, r"drive_11\.db3: cannot be read as a bag: .*; read without it"),
    ],
)
def test_a_split_recording_whose_last_file_is_cut(
    bags: Any, tmp_path: Path, plugin: str, keep: float, count: int, note: str
) -> None:
    """All intact messages are read in time order, and the damaged file is named."""
    last = split(bags, tmp_path / "drive", plugin)[-1]
    last.write_bytes(last.read_bytes()[: int(keep * last.stat().st_size)])
    source = BagSource(last.parent)
    assert [frame.points[0, 0] for frame in source.frames()] == list(range(count))
    assert len(source) == count
    assert re.search(note, source.notes[0])


def test_a_split_recording_without_metadata_is_read_in_order_of_time(bags: Any, tmp_path: Path) -> None:
    split(bags, tmp_path / "drive")
    source = BagSource(tmp_path / "drive")
    assert [frame.points[0, 0] for frame in source.frames()] == list(range(24))
    assert "no metadata.yaml; read drive_0.mcap, drive_1.mcap" in source.notes[0]


def test_a_damaged_chunk_costs_the_messages_of_its_file_alone(bags: Any, tmp_path: Path) -> None:
    files = split(bags, tmp_path / "drive", compressed=True)
    whole = files[5].read_bytes()
    chunk = whole.index(b"\x28\xb5\x2f\xfd")  # start of a zstd frame
    files[5].write_bytes(whole[:chunk] + bytes(20) + whole[chunk + 20 :])
    source = BagSource(tmp_path / "drive")
    assert [frame.points[0, 0] for frame in source.frames()] == [*range(10), *range(12, 24)]
    assert any(re.search(r"drive_5\.mcap: damaged after 0 messages of /points", note) for note in source.notes)


# --- compressed recordings


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_messages_that_are_compressed_one_by_one(bags: Any, tmp_path: Path, plugin: str, metadata: bool) -> None:
    """Also if no metadata.yaml declares the compression."""
    bag = bags.write(tmp_path / "b", clouds(bags, [1, 2, 3]), plugin, zstd=True, compression="MESSAGE")
    if not metadata:
        (bag / "metadata.yaml").unlink()
    frames = list(BagSource(bag).frames())
    assert [(frame.points[0, 0], frame.problem) for frame in frames] == [(0, None), (1, None), (2, None)]


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_files_that_are_compressed_are_named_with_what_unpacks_them(
    bags: Any, tmp_path: Path, plugin: str, metadata: bool
) -> None:
    """They are read once they are unpacked."""
    bag = bags.write(tmp_path / "a bag", clouds(bags, [1, 2, 3]), plugin, zstd=True, compression="FILE")
    if not metadata:
        (bag / "metadata.yaml").unlink()
    (packed,) = bag.glob("*.zstd")
    for path in (bag, packed):
        with pytest.raises(UsageError, match=r"\.zstd: compressed as a whole .*: zstd -d '.*a bag'/\*\.zstd"):
            open_source(path)
    packed.with_suffix("").write_bytes(zstd.decompress(packed.read_bytes()))
    source = open_source(bag)
    assert [frame.points[0, 0] for frame in source.frames()] == [0, 1, 2]
    assert any("no metadata.yaml" in note for note in source.notes) != metadata


def test_files_that_metadata_does_not_name_are_not_read(bags: Any, tmp_path: Path) -> None:
    """For example a copy that is cut to size. Topics without a message are those of the metadata."""
    bag = bags.write(tmp_path / "b", clouds(bags, [1, 2, 3]), silent=[("/scan", "sensor_msgs/msg/LaserScan")])
    (bag / "copy.mcap").write_bytes(mcap(bag).read_bytes())
    source = BagSource(bag)
    assert [frame.points[0, 0] for frame in source.frames()] == [0, 1, 2]
    opened = open_bag(bag)
    assert (opened.types["/scan"], opened.counts["/scan"]) == ("sensor_msgs/msg/LaserScan", 0)
