# SPDX-License-Identifier: Apache-2.0
"""A robot is localized in a saved map, which may then grow by the robot's drive."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import State
from dpm2_core.slam.mapping.parts import parts_of
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros.active_map import ActiveMap

from ..helpers.maps import execute
from .test_active_map import LOG, described, keyframes, street


@pytest.fixture
def found(tmp_path: Path) -> Iterator[ActiveMap]:
    """A robot that is localized in tmp_path/drive.dpm2map, a map that does not change."""
    made = ActiveMap(described(map_directory=str(tmp_path)), "", LOG)
    for n in (0, 5, 10, 15):
        made.add(street(n))
    made.close()
    active = ActiveMap(described(map_file=str(tmp_path / "drive.dpm2map"), localization_mode=True), "", LOG)
    for n in (4, 5):
        active.add(street(n))
    assert active.slam.state(State.TRACKING) is State.TRACKING
    yield active
    active.close()


@pytest.mark.weights
def test_where_its_map_cannot_grow_a_robot_is_found_as_before(
    found: ActiveMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While another program locks the map file, the robot is still localized; later, the map grows from the robot's
    pose."""
    monkeypatch.setattr("dpm2_core.slam.store.map_connection.BUSY", 0.1)
    with closing(sqlite3.connect(tmp_path / "drive.dpm2map", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(Dpm2Error, match="locked"):
            found.extend()
    found.add(street(9))
    assert found.located is not None
    assert found.located.registration.ok
    assert "is extended by a new session" in found.extend()
    found.add(street(12))
    T_map_odom = found.T_map_odom("")
    assert T_map_odom is not None
    np.testing.assert_allclose(T_map_odom, np.eye(4), atol=0.1)  # m: as accurate as the localization
    assert len(found.mapper.keyframes) == 5
    found.close()
    with MapStore.open(tmp_path / "drive.dpm2map") as store:
        data = load_map(store)
        assert parts_of(data).tolist() == [0] * 5  # exports left out parts without an edge
        assert [(edge.from_node, edge.to_node) for edge in data.constraints][-1] == (2, 4)  # 10 is nearest to 12


@pytest.mark.weights
def test_an_odometry_that_starts_again_before_the_first_keyframe_of_a_session_is_not_placed(found: ActiveMap) -> None:
    """The new odometry has no pose until a loop is found. Previously, it was tied rigidly to the last pose of the
    previous odometry."""
    found.extend()
    assert found.T_map_odom("") is not None
    found.restart("")
    for keyframe in keyframes(2):
        found.add(keyframe)
    assert found.T_map_odom("") is None
    assert found.mapper.placed.tolist() == [True] * 4 + [False] * 2


@pytest.mark.weights
def test_a_map_that_cannot_be_read_does_not_confirm_a_place(
    found: ActiveMap, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """If the map's clouds are damaged, the state becomes degraded, then lost, as if nothing matched.

    The reason is logged once. Previously, it was logged only when the state changed: never, if the robot had not been
    localized yet.
    """
    execute(tmp_path / "drive.dpm2map", "UPDATE payloads SET cloud = x'00'")
    states = []
    for n in (13, 14, 15):
        found.add(street(n))
        assert found.located is not None
        assert "see dpm2 map check" in found.located.registration.reason
        states.append(found.located.state)
    assert states == [State.DEGRADED, State.DEGRADED, State.LOST]
    assert found.T_map_odom("") is None
    (told,) = (record for record in caplog.records if record.levelno == logging.ERROR)
    assert "see dpm2 map check" in told.getMessage()


@pytest.mark.weights
def test_the_own_map_is_known_by_any_spelling_of_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two spellings of the path are the same map. Previously, the file was open twice, and FILE-wal was left next to
    it."""
    monkeypatch.chdir(tmp_path)
    active = ActiveMap(described(map_directory=".", map_file=str(tmp_path / "town.dpm2map")), "", LOG)
    active.add(street(0))
    active.localise("town")
    assert [path.name for path in tmp_path.iterdir()] == ["town.dpm2map"]
    active.close()
