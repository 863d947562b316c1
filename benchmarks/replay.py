# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks.replay BAG`: starts slam_node and bag_player together and accounts for each cloud."""

from __future__ import annotations

import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import run_command
from dpm2_core.console import Console
from dpm2_core.errors import Dpm2Error
from dpm2_core.tables import FigureTable
from tools.replay import ros_environment, start, stop

PLAYED = (("--rate", "1"), ("--rate", "2"), ("--lockstep",))
_ACCOUNT = re.compile(r"(\d+) clouds sent: (\d+) processed, (\d+) dropped \(queue full\), (\d+) lost on the way(.*)")


def bench(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or .mcap, such as from `make demo`")],
    times: Annotated[int, typer.Option(min=1, help="Replays at each rate and in lockstep.")] = 5,
) -> int:
    """Play a bag at its own rate, at twice that, and in lockstep. Exit code 1 if a cloud is not accounted for."""
    figures = ("sent", "processed", "dropped", "lost", "sum", "playing s")
    title = f"{bag}, node and player started together"
    table = FigureTable(title, names=["played"], figures=figures, text=["remarks"])
    unaccounted = 0
    for played in PLAYED:
        for _ in range(times):
            sent, (_, *counts), rest, seconds = together(bag, played)
            unaccounted += sum(counts) != sent
            row = (sent, *counts, sum(counts), f"{seconds:.1f}", rest.strip(", "))
            table.add_row(" ".join(played), *map(str, row))
    Console().print(table)
    return 1 if unaccounted else 0


def together(bag: Path, played: tuple[str, ...]) -> tuple[int, tuple[int, ...], str, float]:
    """One replay into a node with its defaults, which saves nothing.

    Returns:
        Clouds sent by the player; clouds counted by the node: all, processed, dropped, lost; its further remarks;
        seconds from the first message to the last.

    Raises:
        Dpm2Error: a process failed.
    """
    with tempfile.TemporaryDirectory(prefix="dpm2_replay_") as folder:
        environment, logs = ros_environment(), Path(folder)
        node_arguments = ["--ros-args", "-p", "ros.map_directory:=''", "-p", "use_sim_time:=true"]
        node = start("slam_node", node_arguments, environment, logs / "slam_node")
        times = logs / "times.csv"
        player = start("bag_player", [str(bag), *played, "--log", str(times)], environment, logs / "bag_player")
        try:
            code = player.wait()
            time.sleep(3.0)  # for the node's queue: ten clouds
        finally:
            player.kill()
            node_code = stop(node)
        message = {name: (logs / name).read_text(errors="replace") for name in ("slam_node", "bag_player")}
        account = _ACCOUNT.search(message["slam_node"])
        sent = re.search(r"(\d+) of them clouds", message["bag_player"])
        if code or node_code or account is None or sent is None:
            raise Dpm2Error("a replay failed:\n" + "\n".join(message.values()))
        published = [int(line.rsplit(",", 1)[1]) for line in times.read_text().splitlines()[1:]]
        counts = tuple(int(number) for number in account.groups()[:4])
        return int(sent[1]), counts, account[5], (published[-1] - published[0]) * 1e-9


if __name__ == "__main__":
    sys.exit(run_command(bench))
