# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy allows what the nodes do, and nothing else."""

from __future__ import annotations

import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dpm2_ros.mapper_node import MapperNode
from dpm2_ros.slam_node import SlamNode

POLICY = Path(__file__).parents[2] / "config" / "sros2_policy.xml"
KINDS = {"publish": "publisher", "subscribe": "subscriber", "reply": "service", "request": "client"}
Graph = dict[str, set[str]]


def allowed(node: str) -> Graph:
    """What the policy allows a node to do, by kind, with names as in the graph."""
    (profile,) = ET.parse(POLICY).getroot().findall(f"enclaves/enclave[@path='/dpm2/{node}']/profiles/profile")
    assert (profile.get("node"), profile.get("ns")) == (node, "/")
    out: Graph = {kind: set() for kind in KINDS.values()}
    for section in profile:
        for rule, permission in section.attrib.items():
            assert permission == "ALLOW"
            names = [str(item.text).replace("~", node) for item in section]
            assert len(set(names)) == len(names)
            out[KINDS[rule]] |= {f"/{name.lstrip('/')}" for name in names}
    return out


def done(harness: Any, node: str, missing: Callable[[Graph], bool]) -> Graph:
    """What another node sees a node do, by kind, once nothing is missing."""

    def look() -> Graph:
        if node not in harness.node.get_node_names():
            return {kind: set() for kind in KINDS.values()}
        looks = {kind: getattr(harness.node, f"get_{kind}_names_and_types_by_node") for kind in KINDS.values()}
        return {kind: {name for name, _ in find(node, "/")} for kind, find in looks.items()}

    harness.wait(lambda: not missing(look()), f"all that {node} does")
    time.sleep(0.5)  # for anything beyond that
    return look()


EMBEDDED = {"subscriber": {"/clock", "/dpm2/keyframes_received"}}
LIFECYCLE = ("change_state", "get_available_states", "get_available_transitions", "get_state", "get_transition_graph")
PLAIN = {
    "publisher": {"/slam_node/transition_event"},
    "service": {f"/slam_node/{name}" for name in LIFECYCLE},
}
OF_THE_MAP = ("grid", "loop_candidates", "loop_closure", "map", "path", "pose_graph")
APART = {
    "publisher": {f"/dpm2/{name}" for name in OF_THE_MAP} | PLAIN["publisher"],
    "service": {"/slam_node/save_map"} | PLAIN["service"],
}


@pytest.mark.parametrize(
    ("make", "managed", "parameters", "without"),
    [
        (SlamNode, True, (), EMBEDDED),
        (SlamNode, False, ("ros.embed_mapper:=false", "use_sim_time:=true"), APART),
        (MapperNode, True, ("use_sim_time:=true",), {}),
    ],
)
def test_nodes_do_what_the_policy_allows(
    ros: Callable[..., Any], make: Any, managed: bool, parameters: tuple[str, ...], without: Graph
) -> None:
    """A node does all that the policy allows and nothing else, except for what its mode of operation leaves out."""
    harness = ros("slam.loops.descriptors:=false", "slam.registration:=geometric", *parameters)
    made = make(managed)
    if managed:
        made.trigger_configure()
        made.trigger_activate()
    node = harness.add(made).get_name()
    expected = {kind: names - without.get(kind, set()) for kind, names in allowed(node).items()}
    assert done(harness, node, lambda graph: any(expected[kind] - graph[kind] for kind in graph)) == expected


def test_the_player_does_what_the_policy_allows(ros: Callable[..., Any], bag: Path, tmp_path: Path) -> None:
    """The player does all that the policy allows, with a bag that `dpm2 convert` makes of KITTI."""
    harness = ros()
    harness.start("bag_player", [str(bag), "--wait", "180", "--lockstep"], tmp_path / "log")
    expected = allowed("bag_player")
    expected["publisher"].discard("/imu")  # this bag has none
    found = done(harness, "bag_player", lambda graph: any(expected[kind] - graph[kind] for kind in graph))
    assert found == expected
