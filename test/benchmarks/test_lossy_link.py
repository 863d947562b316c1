# SPDX-License-Identifier: Apache-2.0
"""The bad network of `make bench-robots`: it reports what is missing, and its link really fails and loses packets."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.lossy_link import own_network
from dpm2_core.errors import UsageError

ROOT = Path(__file__).parents[2]  # the benchmarks are not installed
LINK = """
import socket, sys, time
from pathlib import Path
from benchmarks import lossy_link
lossy_link.LOSS = 0.2
lossy_link.make_link()
echo = lossy_link.start_mapper([], {"PATH": sys.argv[2]}, Path(sys.argv[1]))
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("10.73.0.1", 7400)); s.settimeout(0.2)

def replies(count):
    got = 0
    for _ in range(count):
        try:
            s.sendto(b"x", ("10.73.0.2", 7400)); s.recv(9); got += 1
        except OSError:
            pass
    return got

end = time.monotonic() + 20
while not replies(1) and time.monotonic() < end:
    time.sleep(0.1)
up = replies(60); lossy_link.switch_link(up=False); down = replies(5)
lossy_link.switch_link(up=True); again = replies(20)
echo.kill()
print(up, down, again)
"""
ECHO = """import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.bind(("", 7400))
while True:
    s.sendto(*s.recvfrom(9))
"""


def _can() -> bool:
    return os.geteuid() == 0 and subprocess.run(["unshare", "--net", "true"], capture_output=True).returncode == 0


def test_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda tool: None if tool == "nft" else tool)
    with pytest.raises(UsageError, match="nft"):
        own_network("benchmarks.robots")


@pytest.mark.skipif(not all(map(shutil.which, ("unshare", "ip", "nft"))) or not _can(), reason="needs root, ip and nft")
def test_the_link_goes_away_comes_back_and_loses_packets(tmp_path) -> None:
    """A fifth is lost each way: 38 of 60 replies are expected; 20 and 55 are beyond four sigma."""
    node = tmp_path / "dpm2_ros" / "executables.py"  # the program at the far end: an echo in place of mapper_node
    node.parent.mkdir()
    node.write_text(ECHO)
    script = LINK.replace("from pathlib", f"import os; os.chdir({str(tmp_path)!r})\nfrom pathlib", 1)
    result = subprocess.run(
        ["unshare", "--net", sys.executable, "-c", script, str(tmp_path / "log"), os.environ["PATH"]],
        capture_output=True, text=True, timeout=60, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    up, down, again = map(int, result.stdout.split())
    assert 20 <= up <= 55, (tmp_path / "log").read_text()
    assert down == 0
    assert again > 4
