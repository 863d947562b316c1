# SPDX-License-Identifier: Apache-2.0
"""Hostile files: each is rejected with one line that names it, within 2 s, and with little memory."""

from __future__ import annotations

import json
import resource
import sqlite3
import struct
import time
import tracemalloc
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from dpm2_core.cli import main
from dpm2_core.errors import UsageError
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.weights import load_model
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.rows import array_bytes, with_crc

from ..helpers.maps import execute as sql

ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x, '', '', '', '' FROM n"
BOMB = zlib.compress(bytes(300_000_000), 1)
I4 = array_bytes(np.eye(4))
NAN = array_bytes(np.full((4, 4), np.nan))


def keyframe(node: int, id: object = 0, robot: object = "", T: bytes = I4, lender: object = None) -> tuple[object, ...]:
    return with_crc(node, id, robot, 1, 0, 0, T, lender, None if lender is None else I4)


def put_keyframe(*row: object, **columns: object) -> Callable[[Path], None]:
    return lambda path: sql(path, ("REPLACE INTO keyframes VALUES (?,?,?,?,?,?,?,?,?,?)", keyframe(*row, **columns)))  # type: ignore[arg-type]


def put_payload(node: int, cloud: bytes, descriptors: bytes | None = None) -> Callable[[Path], None]:
    return lambda path: sql(
        path, ("REPLACE INTO payloads VALUES (?,?,?,?,?)", with_crc(node, cloud, descriptors, None))
    )


def lender_circle(path: Path) -> None:
    put_keyframe(3, lender=4)(path)
    put_keyframe(4, lender=3)(path)


def endless_view(path: Path) -> None:
    columns = "session, program, started, config, weights"
    sql(path, "DROP TABLE sessions", f"CREATE VIEW sessions({columns}) AS {ENDLESS}")


def trigger(path: Path) -> None:
    sql(path, f"CREATE TRIGGER t AFTER INSERT ON sessions BEGIN INSERT INTO trail SELECT * FROM ({ENDLESS}); END")


def computed_column(path: Path) -> None:
    columns = "node INTEGER PRIMARY KEY, mask BLOB AS (zeroblob(60000000)) VIRTUAL, crc INTEGER NOT NULL"
    sql(path, "DROP TABLE moving", f"CREATE TABLE moving ({columns})", "INSERT INTO moving VALUES (1, 2)")


def tree_in_a_circle(path: Path) -> None:
    """The pages below the root of `edges` are all the same page, many times."""
    T, C = I4, array_bytes(np.eye(6))
    rows = [with_crc(i, "loop", 0, 1, T, C, 1, 1.0, 0.1, "", "") for i in range(20, 400)]
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executemany("INSERT INTO edges VALUES (?,?,?,?,?,?,?,?,?,?,?,?)", rows)
        root, size = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'edges'").fetchone()[0], 4096
    data = bytearray(path.read_bytes())
    start = (root - 1) * size
    assert data[start] == 5  # an inner page
    cells = struct.unpack_from(">H", data, start + 3)[0]
    first = struct.unpack_from(">H", data, start + 12)[0]
    child = data[start + first : start + first + 4]
    for cell in range(cells):
        at = struct.unpack_from(">H", data, start + 12 + 2 * cell)[0]
        data[start + at : start + at + 4] = child
    path.write_bytes(data)


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 4 // 5])


MAPS: dict[str, Callable[[Path], None]] = {
    "a view without end": endless_view,
    "a trigger": trigger,
    "another table": lambda path: sql(path, "CREATE TABLE more (x)"),
    "an index": lambda path: sql(path, "CREATE INDEX i ON edges (abs(ok))"),
    "a computed column": computed_column,
    "a tree in a circle": tree_in_a_circle,
    "cut off": cut_off,
    "a pose that is not a number": lambda path: sql(
        path, ("REPLACE INTO poses VALUES (?,?,?)", with_crc(4, NAN))
    ),
    "an odometry pose that is not a number": put_keyframe(4, T=NAN),
    "a pose of two numbers": put_keyframe(4, T=I4[:16]),
    "an id in words": put_keyframe(4, id="four"),
    "a name of a million letters": put_keyframe(4, robot="x" * 1_000_000),
    "lenders in a circle": lender_circle,
    "a lender that is not there": put_keyframe(4, lender=99),
    "a lender in words": put_keyframe(4, lender="keyframe 1"),
    "an edge to nowhere": lambda path: sql(
        path,
        ("INSERT INTO edges VALUES (?,?,?,?,?,?,?,?,?,?,?,?)",
         with_crc(90, "loop", 0, 2**62, I4, array_bytes(np.eye(6)), 1, 1.0, 0.1, "", "")),
    ),
    "a covariance below zero": lambda path: sql(
        path,
        ("INSERT INTO edges VALUES (?,?,?,?,?,?,?,?,?,?,?,?)",
         with_crc(90, "loop", 0, 2, I4, array_bytes(-np.eye(6)), 1, 1.0, 0.1, "", "")),
    ),
    "a cloud that is a bomb": put_payload(4, struct.pack("<If", 2**21, 0.01) + BOMB),
    "a cloud of 4e9 points": put_payload(4, struct.pack("<If", 2**32 - 1, 0.01) + BOMB),
    "a cloud with infinite steps": put_payload(4, struct.pack("<If", 1, np.inf) + zlib.compress(bytes(7))),
    "a mask that is a bomb": lambda path: sql(path, ("REPLACE INTO moving VALUES (?,?,?)", with_crc(4, BOMB))),
    "descriptors of 1.8e19 values": put_payload(
        4, struct.pack("<If", 0, 0.01) + zlib.compress(b""), struct.pack("<IIB", 2**32 - 1, 2**32 - 1, 1)
    ),
    "a row that is numbered 2^62": lambda path: sql(path, ("INSERT INTO poses VALUES (?,?,?)", with_crc(2**62, I4))),
}  # fmt: skip


@pytest.fixture(scope="module")
def imported() -> None:
    """Import the commands' modules before any measurement: this takes longer than a file may."""
    for command in (["export", "none.dpm2map", "none.ply"], ["check", "none.dpm2map"]):
        with suppress(SystemExit):
            main(["map", *command])


def rejected(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The error message of `dpm2` for a file that it rejects; CPU time is measured, since the machine may be busy."""
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    seconds, memory = time.process_time() - began, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert ended.value.code in (1, 2)
    info = capsys.readouterr().err
    assert info.count("\n") == 1, info
    assert seconds < 2 * 3  # tracemalloc takes two thirds of the time
    assert memory < 64e6
    return info


@pytest.mark.slow
@pytest.mark.usefixtures("imported")
@pytest.mark.parametrize("attack", MAPS)
def test_a_hostile_map(tmp_path: Path, map_file: Path, attack: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Exporting its cloud reads all but descriptors, checking reads them, too; neither leaves a file behind."""
    MAPS[attack](map_file)
    # Only the check reads descriptors, and rows that nothing refers to.
    only_checked = attack in ("descriptors of 1.8e19 values", "a row that is numbered 2^62")
    if not only_checked:
        info = rejected(["map", "export", str(map_file), str(tmp_path / "out.ply")], capsys)
        assert str(map_file) in info
    info = rejected(["map", "check", str(map_file)], capsys)
    assert str(map_file) in info
    assert sorted(path.name for path in tmp_path.iterdir()) == [map_file.name]


@pytest.mark.parametrize("attack", MAPS)
def test_what_is_good_of_a_hostile_map_can_be_recovered(tmp_path: Path, map_file: Path, attack: str) -> None:
    """At least ten of its twelve keyframes are in a sound map; of a truncated file, those that are left."""
    MAPS[attack](map_file)
    result = check_map(map_file, tmp_path / "good.dpm2map")
    assert result.problems
    assert result.keyframes >= (1 if attack == "cut off" else 10)
    assert check_map(tmp_path / "good.dpm2map").problems == []


def changed(**sections: object) -> Callable[[DeepPointMap2], dict[str, str]]:
    """A description of the network with other values; the tensors are unchanged."""

    def make(model: DeepPointMap2) -> dict[str, str]:
        tree = model.settings.model_dump(mode="json")
        for name, values in sections.items():
            tree[name] = {**tree[name], **values} if isinstance(values, dict) else values
        return {"preset": "tiny", "network": json.dumps(tree)}

    return make


WEIGHTS: dict[str, tuple[Callable[[DeepPointMap2], dict[str, str]], str]] = {
    "a hub's name": (changed(image={"backbone": "timm:hf-hub:owner/model"}), "not allowed in a weights file"),
    "an address": (changed(image={"backbone": "timm:local-dir:/etc"}), "not allowed in a weights file"),
    "1e12 channels": (changed(channels=10**12), "network.channels is 1000000000000; at most 65536"),
    "65,536 channels": (changed(decoder={"width": 65536}), "does not fit the network that it describes"),
    "a billion layers": (changed(decoder={"layers": 10**9}), "layers is 1000000000; at most"),
    "65,536 layers": (changed(fusion={"layers": 65536}), "less than or equal to 64"),
    "an image of a terapixel": (changed(image={"size": [10**6, 10**6]}), "image.size is 1000000"),
    "a number without end": (changed(points={"far": float("inf")}), "points.far is inf"),
    "heads that do not divide": (changed(decoder={"heads": 7}), "describes an invalid network"),
    "no JSON": (lambda model: {"preset": "tiny", "network": "{" * 100}, "not JSON"),
    "JSON without end": (lambda model: {"preset": "tiny", "network": "[" * 200_000}, "not JSON"),
    "a list": (lambda model: {"preset": "tiny", "network": "[1]"}, "not a mapping"),
}


@pytest.mark.parametrize("attack", WEIGHTS)
def test_hostile_weights(tmp_path: Path, model: DeepPointMap2, attack: str) -> None:
    """They are rejected before memory is allocated for the described network, and without a network connection."""
    path = tmp_path / "a.safetensors"
    describe, words = WEIGHTS[attack]
    save_file({name: value.contiguous() for name, value in model.state_dict().items()}, path, describe(model))
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    with pytest.raises(UsageError) as caught:
        load_model(path)
    assert time.process_time() - began < 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 256e3  # kB; 65,536 x 65,536 numbers are 17 GB
    info = str(caught.value)
    assert words in info
    assert str(path) in info or attack == "65,536 layers"
    assert "\n" not in info


def test_weights_that_are_cut_off_or_not_finite(tmp_path: Path, model: DeepPointMap2) -> None:
    path = tmp_path / "a.safetensors"
    state = {name: value.contiguous() for name, value in model.state_dict().items()}
    about = changed()(model)
    save_file(state, path, about)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UsageError, match="not a safetensors file"):
        load_model(path)
    name = min(name for name, value in state.items() if value.is_floating_point())
    save_file({**state, name: torch.full_like(state[name], torch.nan)}, path, about)
    with pytest.raises(UsageError, match="values that are not finite"):
        load_model(path)


def test_names_in_a_map_are_printed_and_not_interpreted(
    tmp_path: Path, map_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither rich's markup nor control sequences of a terminal take effect."""
    evil = "[red]x[/nope] :boom: \x1b]0;title\x07\x1b[2J\u202e\r"
    for node in range(12):
        put_keyframe(node, robot=evil)(map_file)
    sql(map_file, ("UPDATE sessions SET program = ?, weights = ?", (evil, evil)))
    with pytest.raises(SystemExit) as ended:
        main(["map", "info", str(map_file)])
    assert ended.value.code == 0
    info = capsys.readouterr().out
    assert "[red]x[/nope] :boom: \\x1b]0;title\\x07\\x1b[2J\\u202e\\r" in info
    assert not any(ord(c) < 32 and c != "\n" for c in info)
    sql(map_file, f'CREATE TABLE "{evil}" (x)')
    assert "[red]x[/nope]" in rejected(["map", "info", str(map_file)], capsys)
