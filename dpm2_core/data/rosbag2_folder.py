# SPDX-License-Identifier: Apache-2.0
"""Finds the files of a recording in a rosbag2 folder from its metadata.yaml."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePath
from shlex import quote

import yaml

from dpm2_core.errors import UsageError, one_line

STORAGES = (".mcap", ".db3")
PACKED = tuple(f"{storage}.zstd" for storage in STORAGES)
"""Endings of files that are compressed as a whole."""


def recorded(folder: Path) -> tuple[list[Path], dict[str, str]]:
    """The files named in metadata.yaml, and topic to message type, including topics without messages.

    Raises:
        UsageError: metadata.yaml is unusable, or files are missing.
    """
    try:
        text = (folder / "metadata.yaml").read_text(encoding="utf-8")
        about = yaml.safe_load(text)["rosbag2_bagfile_information"]
        files = [folder / PurePath(name.removesuffix(".zstd")).name for name in about["relative_file_paths"]]
        topics = [topic["topic_metadata"] for topic in about["topics_with_message_count"]]
        types = {str(topic["name"]): str(topic["type"]) for topic in topics}
    except FileNotFoundError:
        raise UsageError(f"{folder}: no metadata.yaml") from None
    except Exception as error:  # anything from YAMLError to TypeError by the kind of damage
        raise UsageError(f"{folder}: metadata.yaml is unusable ({one_line(error)})") from None
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        raise UsageError(f"{folder}: metadata.yaml is unusable (no file {', '.join(missing)})")
    return files, types


def check_unpacked(files: Iterable[Path]) -> None:
    """Reject compressed files. They are not decompressed here, because the result may be huge: the user decides.

    Raises:
        UsageError: a file is compressed as a whole; the message has the command to decompress it.
    """
    for file in files:
        if file.name.endswith(PACKED) and not file.with_suffix("").is_file():
            command = f"zstd -d {quote(str(file.parent))}/*.zstd"
            raise UsageError(f"{file}: compressed as a whole (--compression-mode file); unpack it: {command}")
