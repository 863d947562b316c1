# SPDX-License-Identifier: Apache-2.0
"""Every drive leaves a map that can be loaded, and changes nothing in earlier maps."""

from __future__ import annotations

import logging
import re
import sqlite3
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.cli import main
from dpm2_core.config import dump_settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Keyframe, Registration, State
from dpm2_core.geometry import se3
from dpm2_core.slam.build import make_map
from dpm2_core.slam.session import open_session
from dpm2_core.slam.store.check import check_map
from dpm2_ros.active_map import ActiveMap
from dpm2_ros.settings import NodeConfig

from .conftest import pose, scan

LOG = logging.getLogger("test")


def config(**ros: Any) -> NodeConfig:
    return NodeConfig.model_validate({"ros": ros, "slam": {"loops": {"descriptors": False}}})


def keyframes(count: int) -> list[Keyframe]:
    noise = np.random.default_rng(0)
    step, out = se3.exp([0, 0, 0.02, 3.0, 0, 0]), []
    for id in range(count):
        cloud = np.column_stack([noise.uniform(-30, 30, (500, 2)), noise.uniform(-2, 4, 500), noise.random(500)])
        edge = Registration(step, np.eye(6) * 1e-4, 1.0, 0.01, "test") if id else None
        T = np.linalg.matrix_power(step, id)
        out.append(Keyframe(id, id, id, T, cloud.astype(np.float32), edge))
    return out


def driven(count: int, robot: str = "", **ros: Any) -> ActiveMap:
    """An open map of `count` keyframes."""
    active = ActiveMap(config(**ros), robot, LOG)
    for keyframe in keyframes(count):
        active.add(keyframe)
    return active


def drive(directory: Path, count: int = 3, robot: str = "", **ros: Any) -> None:
    """A whole drive, from the start of a node to its end."""
    active = driven(count, robot, map_directory=str(directory), **ros)
    if count:
        active.save()
    active.close()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    """Drives of two robots into one folder: each map is sound, and no later drive changes it."""
    before: dict[str, bytes] = {}
    for robot, name in (("", "drive"), ("", "drive-2"), ("blue/one", "drive_blue_one"), ("", "drive-3")):
        drive(tmp_path, robot=robot)
        after = contents(tmp_path)
        files = {f"{name}.dpm2map", *(f"{name}/{kind}" for kind in ("map.ply", "pose_graph.g2o", "trajectory.tum"))}
        assert after.keys() - before.keys() == files
        assert {path: after[path] for path in before} == before
        result = check_map(tmp_path / f"{name}.dpm2map")
        assert (result.problems, result.keyframes) == ([], 3)
        before = after


def test_a_map_that_was_asked_for_by_name_and_does_not_go_on_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """If the named map file exists already, as after a crash of mapper_node, the name of the new map is reported.
    Drives without a named file, and resets, start a new map without a warning."""
    caplog.set_level(logging.WARNING)
    town = tmp_path / "town.dpm2map"
    for file in ("auto", "auto", str(town)):
        drive(tmp_path, map_file=file)
    assert caplog.text == ""
    active = ActiveMap(config(map_directory=str(tmp_path), map_file=str(town)), "", LOG)
    assert f"{town} exists already and is not changed: {tmp_path / 'town-2.dpm2map'} is a new map" in caplog.text
    caplog.clear()
    active.add(keyframes(1)[0])
    active.reset()
    active.close()
    assert caplog.text == ""


def test_a_map_does_not_begin_beside_the_log_of_one_that_was_removed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """If only the log of a removed map is left, the next number is taken: a new map next to that log would contain its
    keyframes or be malformed."""
    log = tmp_path / "drive.dpm2map-wal"
    log.write_bytes(b"log")
    drive(tmp_path)
    assert check_map(tmp_path / "drive-2.dpm2map").keyframes == 3
    drive(tmp_path, map_file=str(tmp_path / "drive.dpm2map"))
    assert f"{log} exists already and is not changed" in caplog.text
    assert log.read_bytes() == b"log"


def test_a_copy_of_the_map_leaves_the_log_of_one_that_was_moved(tmp_path: Path) -> None:
    """The moved map lacks its last keyframes until the log is next to it again, so saving a copy must not replace the
    log."""
    log = tmp_path / "town.dpm2map-wal"
    log.write_bytes(b"log")
    active = driven(1, map_directory=str(tmp_path))
    assert str(tmp_path / "town-2.dpm2map") in active.save("town")
    active.close()
    assert log.read_bytes() == b"log"


def test_a_folder_without_its_map_file_keeps_its_name(tmp_path: Path) -> None:
    """A folder without a map file, as from `ros.map_file:=''` or dpm2 0.1, is not overwritten by a later drive."""
    drive(tmp_path, map_file="")
    assert sorted(contents(tmp_path)) == ["drive/map.ply", "drive/pose_graph.g2o", "drive/trajectory.tum"]
    drive(tmp_path)
    drive(tmp_path, map_file="")
    assert {path.name for path in tmp_path.iterdir()} == {"drive", "drive-2", "drive-2.dpm2map", "drive-3"}


def test_a_second_save_of_one_drive_replaces_the_first(tmp_path: Path) -> None:
    active = ActiveMap(config(map_directory=str(tmp_path)), "", LOG)
    for keyframe in keyframes(3):
        active.add(keyframe)
        info = active.save()
    assert info == f"map of 3 keyframes saved in {tmp_path / 'drive'}, and as {tmp_path / 'drive.dpm2map'}"
    active.close()
    assert {path.name for path in tmp_path.iterdir()} == {"drive", "drive.dpm2map"}
    assert len((tmp_path / "drive" / "trajectory.tum").read_text().splitlines()) == 1 + 3


def test_a_map_is_saved_under_a_name_as_well(tmp_path: Path) -> None:
    """The copy is complete and does not grow. The same drive replaces it; another drive gets a name with a number."""
    active = driven(2, map_directory=str(tmp_path))
    assert str(tmp_path / "town.dpm2map") in active.save("town")
    active.add(Keyframe(**vars(keyframes(3)[2])))
    assert check_map(tmp_path / "town.dpm2map").keyframes == 2
    active.save("town")
    active.close()
    for name in ("town", "drive"):
        result = check_map(tmp_path / f"{name}.dpm2map")
        assert (result.problems, result.keyframes) == ([], 3)
    before = contents(tmp_path)
    other = driven(1, map_directory=str(tmp_path))
    other.save("town.dpm2map")
    other.close()
    after = contents(tmp_path)
    assert {path: after[path] for path in before} == before
    assert check_map(tmp_path / "town-2.dpm2map").keyframes == 1
    assert (tmp_path / "town-2" / "map.ply").is_file()


def test_a_name_that_leads_to_the_file_of_the_drive_itself_is_no_copy(tmp_path: Path) -> None:
    """If the name is a link to the drive's own file, no copy is made. Previously, a copy replaced the file that the
    node was writing to, and no later keyframe was kept."""
    active, town = driven(2, map_directory=str(tmp_path)), tmp_path / "town.dpm2map"
    active.save("town")
    town.unlink()
    town.symlink_to("drive.dpm2map")
    active.save("town")
    active.add(keyframes(3)[2])
    active.close()
    result = check_map(tmp_path / "drive.dpm2map")
    assert (result.problems, result.keyframes) == ([], 3)


@pytest.mark.parametrize("name", ["../town", "a/b", ".hidden", "", "x" * 200, "a b", "town\n"])
def test_a_name_stays_within_the_folder(name: str) -> None:
    if name:
        with pytest.raises(ValueError, match="map_name"):
            config(map_name=name)
    else:
        config(map_name=name)


def test_an_empty_value_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No folder and no file is made for an empty setting, even if the other one is given; an empty drive makes
    neither."""
    monkeypatch.chdir(tmp_path)
    for ros in ({"map_directory": ""}, {"map_directory": "", "map_file": ""}):
        active = driven(1, **ros)
        with pytest.raises(UsageError, match=r"no map is saved: ros.map_directory is empty"):
            active.save()
        assert active.keep() == ""
        active.reset()
        active.close()
    drive(tmp_path / "maps", count=0)
    assert list(tmp_path.iterdir()) == []
    active = driven(1, map_directory="", map_file="town.dpm2map")
    active.close()
    assert list(tmp_path.iterdir()) == [tmp_path / "town.dpm2map"]


def test_a_file_that_cannot_be_made_is_known_until_there_is_one(tmp_path: Path) -> None:
    """The map grows in memory without a file, and the problem is reported until a file can be made."""
    directory = tmp_path / "maps"
    directory.write_text("no folder")
    active = ActiveMap(config(map_directory=str(directory)), "", LOG)
    assert str(directory) in active.file_problem
    active.add(keyframes(1)[0])
    assert len(active.mapper.keyframes) == 1
    directory.unlink()
    active.reset()
    assert active.file_problem == ""
    active.close()


def test_a_map_whose_file_could_not_be_made_is_not_said_to_be_saved(tmp_path: Path) -> None:
    """If the map file could not be made because the disk was full, saving fails. Previously, `town` was reported as
    saved, but there was no map to localize in."""
    (tmp_path / "full").write_text("no folder")
    active = driven(2, map_directory=str(tmp_path / "maps"), map_file=str(tmp_path / "full" / "a.dpm2map"))
    with pytest.raises(Dpm2Error, match=r"map of 2 keyframes saved in .*town, but there is no map file: .*full"):
        active.save("town")
    assert [path.name for path in (tmp_path / "maps").iterdir()] == ["town"]
    (tmp_path / "full").unlink()
    assert "but there is no map file: " in active.keep()
    active.reset()  # now the file can be made
    active.add(keyframes(1)[0])
    assert re.search(r"map of 1 keyframes saved in .*, and as .*a-2\.dpm2map", active.save())
    active.close()


def test_what_a_reset_ends_is_kept(tmp_path: Path) -> None:
    active = driven(3, map_directory=str(tmp_path))
    assert "map of 3 keyframes saved" in active.keep()
    active.reset()
    assert len(active.mapper.keyframes) == 0
    active.add(keyframes(1)[0])
    active.close()
    assert [check_map(tmp_path / f"{name}.dpm2map").keyframes for name in ("drive", "drive-2")] == [3, 1]
    assert (tmp_path / "drive" / "map.ply").is_file()


def test_a_map_that_cannot_be_kept_goes_on(tmp_path: Path) -> None:
    active = driven(2, map_directory=str(tmp_path / "maps"), map_file=str(tmp_path / "a.dpm2map"))
    (tmp_path / "maps").write_text("in the way")
    before = active.T_map_odom("")
    with pytest.raises(Dpm2Error, match=r"maps.*no map saved"):
        active.keep()
    assert active.T_map_odom("") is before
    active.add(keyframes(3)[2])
    active.close()
    result = check_map(tmp_path / "a.dpm2map")
    assert (result.problems, result.keyframes) == ([], 3)


def test_a_map_whose_file_is_incomplete_is_not_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While another program locks the file, which acts as a full disk, the folder is saved but no copy. Later all is
    saved."""
    monkeypatch.setattr("dpm2_core.slam.store.map_connection.BUSY", 0.1)
    active = driven(1, map_directory=str(tmp_path))
    with closing(sqlite3.connect(tmp_path / "drive.dpm2map", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        active.add(keyframes(2)[1])
        with pytest.raises(Dpm2Error, match=r"saved in .*town, but its file is incomplete: .*locked; 1 keyframes"):
            active.save("town")
    assert (tmp_path / "town" / "map.ply").is_file()
    assert not (tmp_path / "town.dpm2map").exists()
    assert "map of 2 keyframes saved" in active.save("town")
    active.close()
    assert check_map(tmp_path / "town.dpm2map").keyframes == 2


@pytest.mark.parametrize("name", ["", "town"])
def test_a_map_whose_file_was_moved_since_the_last_keyframe_is_not_saved(tmp_path: Path, name: str) -> None:
    """Saving fails until the file is back. Previously, the map was reported as saved in a file that did not exist."""
    active = driven(1, map_directory=str(tmp_path))
    path, elsewhere = tmp_path / "drive.dpm2map", tmp_path / "elsewhere"
    path.rename(elsewhere)
    with pytest.raises(Dpm2Error, match=f"but its file is incomplete: {path}: removed or moved"):
        active.save(name)
    elsewhere.rename(path)
    assert "map of 1 keyframes saved" in active.save(name)
    active.close()
    assert check_map(path).keyframes == 1


def described(**ros: Any) -> NodeConfig:
    """The default settings of a node, except for the registration of its odometry."""
    return NodeConfig.model_validate({"ros": ros, "slam": {"registration": "geometric"}})


def test_where_one_robot_starts_again_the_others_stay(tmp_path: Path) -> None:
    active = ActiveMap(config(map_directory=str(tmp_path)), "red", LOG)
    active.add(replace(keyframes(1)[0], robot="red"))
    assert active.T_map_odom("red") is not None
    active.restart("blue")
    assert active.T_map_odom("red") is not None
    active.restart("red")
    assert active.T_map_odom("red") is None
    active.close()


def street(n: int) -> Keyframe:
    """Keyframe after n scans along the street of the small drive."""
    edge = Registration(se3.inverse(pose(n - 1)) @ pose(n), np.eye(6) * 1e-4, 1.0, 0.01, "test") if n else None
    return Keyframe(n, n, n, se3.inverse(pose(0)) @ pose(n), scan(pose(n)), edge)


@pytest.mark.weights
def test_a_drive_that_nothing_ties_to_the_map_is_no_place_in_it(tmp_path: Path) -> None:
    """The map has a drive that no edge connects to the rest. A robot must not be localized in that drive: it was
    `tracking` at an arbitrary pose in the map, 120 m off."""
    made = ActiveMap(described(map_directory=str(tmp_path)), "", LOG)
    made.add(keyframes(1)[0])
    made.close()
    path, settings = tmp_path / "drive.dpm2map", described().slam
    with open_session(path, settings, dump_settings(described()), resume=True) as store:
        mapper, _ = make_map(settings, store)
        for n in (0, 5, 10, 15):
            mapper.add(street(n))
        mapper.finish()
        assert mapper.placed.tolist() == [True] + [False] * 4
    active = ActiveMap(described(map_file=str(path), localization_mode=True), "", LOG)
    for n in (4, 5, 6):
        active.add(street(n))
    assert active.located is not None
    assert active.located.state is State.RELOCALIZING
    active.close()


@pytest.mark.weights
@pytest.mark.parametrize("descriptors", [True, False])
def test_a_growing_map_that_does_not_serve_goes_on(tmp_path: Path, descriptors: bool) -> None:
    """A map without keyframes or without descriptors is rejected for localization, and the drive continues in one
    piece."""
    active = ActiveMap((described if descriptors else config)(map_directory=str(tmp_path)), "", LOG)
    before, reason = (0, "no keyframe yet") if descriptors else (3, "no keyframe has descriptors")
    for keyframe in keyframes(before):
        active.add(keyframe)
    with pytest.raises(UsageError, match=reason):
        active.localise()
    for keyframe in keyframes(5)[before:]:
        active.add(keyframe)
    assert [(edge.from_node, edge.to_node) for edge in active.mapper.edges if edge.ok] == [(n, n + 1) for n in range(4)]
    active.close()
    assert check_map(tmp_path / "drive.dpm2map").keyframes == 5


def another_map(folder: Path) -> None:
    """A map of one keyframe, saved in `folder` as town, in which a robot can localize."""
    made = ActiveMap(described(map_directory=str(folder)), "", LOG)
    made.add(street(0))
    made.save("town")
    made.close()


@pytest.mark.weights
def test_a_map_without_a_file_is_saved_before_another_takes_its_place(tmp_path: Path) -> None:
    """Without a file, the map would be lost. If the requested name has no map, the drive continues in one piece."""
    another_map(tmp_path)
    active = driven(3, map_directory=str(tmp_path), map_file="")
    with pytest.raises(UsageError, match="no such map file"):
        active.localise("nowhere")
    active.add(keyframes(4)[3])
    folder, looking = tmp_path / "drive", f"looking for the robot in {tmp_path / 'town.dpm2map'}, 1 keyframes"
    assert active.localise("town") == f"map of 4 keyframes saved in {folder}; {looking}"
    active.close()
    assert len((folder / "trajectory.tum").read_text().splitlines()) == 1 + 4


@pytest.mark.weights
def test_what_was_saved_last_under_a_name_is_what_is_loaded_by_it(tmp_path: Path) -> None:
    """If another drive has the plain name, the copy is numbered; loading by that name then loads the numbered copy."""
    another_map(tmp_path)
    active = ActiveMap(described(map_directory=str(tmp_path)), "", LOG)
    for n in (0, 5):
        active.add(street(n))
    assert str(tmp_path / "town-2.dpm2map") in active.save("town")
    for name in ("town", "town.dpm2map", "town"):
        assert active.localise(name) == f"looking for the robot in {tmp_path / 'town-2.dpm2map'}, 2 keyframes"
    active.close()


def test_an_odometry_that_starts_again_goes_on_in_the_same_map(tmp_path: Path) -> None:
    """After a looped bag or a clock that was set back, a separate segment begins in the same map; the keyframe ids
    continue."""
    active = ActiveMap(config(map_directory=str(tmp_path)), "", LOG)
    for keyframe in [*keyframes(3), *keyframes(2)]:
        active.add(keyframe)
    assert active.save().endswith("; map.ply and trajectory.tum lack 2 that no loop connects to the first")
    active.close()
    result = check_map(tmp_path / "drive.dpm2map")
    assert (result.problems, result.keyframes) == ([], 5)


def test_what_was_saved_by_default_can_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`dpm2 map check` and `export` accept it, and it is suggested if localization is requested without naming a
    map."""
    drive(tmp_path)
    for arguments in (["check"], ["export", str(tmp_path / "grid.yaml")], ["info"]):
        with pytest.raises(SystemExit) as ended:
            main(["map", arguments[0], str(tmp_path / "drive.dpm2map"), *arguments[1:]])
        assert ended.value.code == 0
    assert "3 keyframes, no damage" in capsys.readouterr().out
    assert (tmp_path / "grid.pgm").is_file()
    with pytest.raises(UsageError, match=r"ros.map_file does not name one; the newest in .* is .*drive\.dpm2map"):
        ActiveMap(config(map_directory=str(tmp_path), localization_mode=True), "", LOG)


def test_two_nodes_that_start_together_do_not_share_a_file(tmp_path: Path) -> None:
    """Eight start at the same time in one folder, with the same name, and each has its own file."""
    made: list[ActiveMap] = []

    def start() -> None:
        made.append(ActiveMap(config(map_directory=str(tmp_path)), "", LOG))

    threads = [threading.Thread(target=start) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for active in made:
        active.add(keyframes(1)[0])
        active.save()
        active.close()
    assert len(list(tmp_path.glob("*.dpm2map"))) == len(list(tmp_path.glob("*/map.ply"))) == 8
