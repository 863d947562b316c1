# SPDX-License-Identifier: Apache-2.0
"""A simulated bad network on one machine, for `make bench-robots`: two network namespaces and a link between them."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from dpm2_core.errors import UsageError

LOSS = 0.01
"""Fraction of the packets dropped on arrival at either end of the link."""
_NAMESPACE_VARIABLE = "DPM2_OWN_NETWORK"
_ROBOTS, _MAPPER = ("robots0", "10.73.0.1/24"), ("mapper0", "10.73.0.2/24")
_RULES = """
nft add table inet link
nft 'add chain inet link arriving {{ type filter hook input priority 0; }}'
nft add rule inet link arriving iifname {name} numgen random mod 10000 '<' {share} drop
"""


def inside() -> bool:
    """Whether this process runs in the namespace created by `own_network`."""
    return _NAMESPACE_VARIABLE in os.environ


def own_network(module: str) -> int:
    """Run a module with this process's arguments in a separate network namespace; returns its exit code.

    Raises:
        UsageError: not root, or `unshare`, `ip` or `nft` is missing.
    """
    missing = [tool for tool in ("unshare", "ip", "nft") if shutil.which(tool) is None]
    if os.geteuid() != 0 or missing:
        raise UsageError(f"a network namespace needs root and util-linux, iproute2, nftables; missing: {missing}")
    command = ["unshare", "--net", sys.executable, "-m", module, *sys.argv[1:]]
    return subprocess.call(command, env=os.environ | {_NAMESPACE_VARIABLE: "1"})


def make_link() -> None:
    """Create the link; this process is at the robots' end of it."""
    _sh(f"ip link set lo up; ip link add {_ROBOTS[0]} type veth peer name {_MAPPER[0]}")
    _sh(f"ip address add {_ROBOTS[1]} dev {_ROBOTS[0]}; ip link set {_ROBOTS[0]} up" + _rules(_ROBOTS[0]))


def start_mapper(arguments: Sequence[str], environment: Mapping[str, str], log: Path) -> subprocess.Popen[bytes]:
    """Start mapper_node at the other end, over UDP: shared memory would bypass the link."""
    name, address = _MAPPER
    node = shlex.join([sys.executable, "-m", "dpm2_ros.executables", "mapper_node", *arguments])
    script = f"""
        until ip link show {name} > /dev/null 2>&1; do sleep 0.1; done
        ip link set lo up; ip address add {address} dev {name}; ip link set {name} up {_rules(name)}
        exec {node}"""
    udp = {key: value for key, value in environment.items() if key != "FASTRTPS_DEFAULT_PROFILES_FILE"}
    with log.open("wb") as file:
        mapper = subprocess.Popen(
            ["unshare", "--net", "sh", "-ec", script],
            env=udp | {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    # The process starts in this namespace: moving the link there too early has no effect.
    _sh(f"while ip link show {name} > /dev/null 2>&1; do ip link set {name} netns {mapper.pid}; sleep 0.1; done")
    return mapper


def switch_link(up: bool) -> None:
    """Take the link down or up."""
    _sh(f"ip link set {_ROBOTS[0]} {'up' if up else 'down'}")


def _rules(name: str) -> str:
    return _RULES.format(name=name, share=round(1e4 * LOSS))


def _sh(script: str) -> None:
    subprocess.run(["sh", "-ec", script], check=True)
