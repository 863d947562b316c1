# SPDX-License-Identifier: Apache-2.0
"""Drives become one map without a prior; drives that do not fit are left out, with the reason; later ones are added."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fleet_drives import poses_of, write_drive
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.evaluation.metrics import ape_rmse
from dpm2_core.fleet.cluster import Cluster, Watch
from dpm2_core.fleet.drives import MAP
from dpm2_core.fleet.joins import ENOUGH, stretches
from dpm2_core.fleet.merge import merge
from dpm2_core.fleet.part import DONE, Advance, Figures, Outcome, Part, do_part
from dpm2_core.fleet.places import WIDTH, FleetIndex
from dpm2_core.fleet.regions import Join
from dpm2_core.fleet.run import View, carry_out
from dpm2_core.fleet.search import Search
from dpm2_core.sim.world import build_world
from dpm2_core.slam.loops.retrieval import Vector
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_data import MapData, append_map, load_map, save_as
from dpm2_core.slam.store.map_file import move_map
from dpm2_core.slam.store.map_store import MapStore
from test.helpers.fleets import fleet_maps
from test.helpers.full_disk import CHECKPOINT, largest_file
from test.helpers.maps import ring


@pytest.mark.long
def test_drives_that_share_a_road_become_one_map_and_others_stay_out(tmp_path: Path) -> None:
    """A drive of another town, a poisonous map and an incomplete one are named; what is added later is found."""
    pytest.importorskip("ray", reason="no ray: pip install 'dpm2_ros[fleet]'")
    pytest.importorskip("faiss", reason="no faiss: pip install 'dpm2_ros[fleet]'")
    town, other = (build_world("straight", "suburb", seed=seed, length=60.0) for seed in (3, 8))
    fleet, out = tmp_path / "fleet", tmp_path / "town.dpm2map"
    truth = {"a": poses_of(town, (0, 35), 1), "b": poses_of(town, (10, 45), 2)}
    write_drive(fleet / "a", town, truth["a"], 1)
    write_drive(fleet / "stranger", other, poses_of(other, (0, 20), 3), 3)
    shutil.copytree(fleet / "a", fleet / "poison")
    content = bytearray((fleet / "poison" / MAP).read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4000] = bytes(4000)
    (fleet / "poison" / MAP).write_bytes(content)
    shutil.copytree(fleet / "a", fleet / "torn")
    (fleet / "torn" / MAP).write_bytes(content[:middle])
    with Cluster(workers=1) as cluster:
        cluster.start()
        first = merge(fleet, out, SlamSettings(), Cluster())
        assert first.drives == {"a": 7}
        assert set(first.left_out) == {"stranger", "poison", "torn"}
        assert "dpm2 map check" in first.left_out["poison"]
        assert first.left_out["torn"].startswith("not complete: it is being written")
        (known,) = (fleet / ".merge" / "joins").glob(f"a/stranger/*/{DONE}")
        before, file = known.stat().st_mtime_ns, out.stat().st_ino
        write_drive(fleet / "b", town, truth["b"], 2)
        both = merge(fleet, out, SlamSettings(), Cluster())
    assert out.stat().st_ino == file, "the map was made anew"
    assert both.drives == {"a": 7, "b": 7}
    assert both.left_out["stranger"] == "no place in common with a"
    assert known.stat().st_mtime_ns == before, "what was found before was searched again"
    accepted = {tuple(row["drives"]): row["accepted"] for row in both.joins}
    assert accepted["a", "b"] >= ENOUGH
    assert sum(accepted.values()) == accepted["a", "b"]
    assert sum(both.rejected.values()) == sum(row["rejected"] for row in both.joins)
    assert all(both.rejected)
    assert not check_map(out).problems
    with MapStore.open(out) as store:
        data = load_map(store)
        assert [keyframe.robot for keyframe in data.keyframes] == ["a"] * 7 + ["b"] * 7
        assert all(keyframe.descriptors is not None for keyframe in data.keyframes)
        assert all(len(data.clouds[node]) for node in range(14))
    assert ape_rmse(np.concatenate([truth["a"], truth["b"]]), data.poses) < 0.3


def test_a_file_that_is_no_merge_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("precious")
    with pytest.raises(UsageError, match="and is no merge of drives"):
        merge(tmp_path, tmp_path / "mine", SlamSettings(), Cluster())
    assert (tmp_path / "mine").read_text() == "precious"
    with pytest.raises(UsageError, match="no complete drive in it"):
        merge(tmp_path, tmp_path / "out", SlamSettings(), Cluster())


class Found:
    """A search that returns known joins."""

    version = 1

    def __init__(self, folder: Path, maps: dict[str, MapData], joins: list[Join]) -> None:
        self.folder, self.settings = folder, SlamSettings()
        self._maps, self._joins = maps, joins

    def drives(self, left_out: dict[str, str]) -> dict[str, Part]:
        return {name: Part(name, "", {"version": self.version}) for name in self._maps}

    def places(self, parts: dict[str, Part], left_out: dict[str, str]) -> dict[str, Figures]:
        return {name: {"keyframes": len(data)} for name, data in self._maps.items()}

    def index(self, parts: dict[str, Part]) -> None:
        pass

    def joins(self, parts: dict[str, Part], index: None, inside: Collection[str] = ()) -> list[Join]:
        return self._joins


def test_a_map_that_does_not_fit_on_the_disk_leaves_the_one_before(
    tmp_path: Path, noise: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This includes a failure of the last step only: all of the new map is then in FILE-wal, but not in the file."""
    _, maps, joins = fleet_maps(3)
    for name, data in maps.items():
        (tmp_path / name).mkdir()
        save_as(replace(data, thumbnail=lambda node: noise.bytes(35_000)), tmp_path / name / MAP)
    monkeypatch.setattr("dpm2_core.fleet.merge.Search", lambda *arguments: Found(tmp_path, maps, joins))
    out = tmp_path / "out" / "town"
    out.parent.mkdir()
    merge(tmp_path, out, SlamSettings(), nullcontext())
    before, size = check_map(out), out.stat().st_size
    assert size > CHECKPOINT + 600_000  # otherwise FILE-wal would be too large first, which is another error
    monkeypatch.setattr(Found, "version", 2)  # all drives have changed by now
    with largest_file(size - 300_000), pytest.raises(Dpm2Error, match=r"town: not written: .*is the disk full"):
        merge(tmp_path, out, SlamSettings(), nullcontext())
    with largest_file(size // 4), pytest.raises(Dpm2Error, match="/town: "):  # not the hidden file in which it is made
        merge(tmp_path, out, SlamSettings(), nullcontext())
    assert check_map(out) == before
    assert (before.keyframes, before.problems) == (180, [])
    assert sorted(os.listdir(out.parent)) == ["town", "town.json"]


@pytest.mark.parametrize("late", [False, True])
def test_a_merge_that_is_stopped_at_its_end_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late: bool
) -> None:
    """A merge that was interrupted after the map had its name can be resumed. Previously, without a record of its
    content, the map counted as a file of another program."""
    out = _fleet(tmp_path, monkeypatch)

    def stopped(source: Path, target: Path) -> None:
        move_map(source, target)
        raise KeyboardInterrupt

    cluster = ExitStack()
    if late:
        cluster.callback(_interrupt)
    else:
        monkeypatch.setattr("dpm2_core.fleet.merge.move_map", stopped)
    with pytest.raises(KeyboardInterrupt):
        merge(tmp_path, out, SlamSettings(), cluster)
    monkeypatch.setattr("dpm2_core.fleet.merge.move_map", move_map)
    file = out.stat().st_ino
    assert sum(merge(tmp_path, out, SlamSettings(), nullcontext()).drives.values()) == 180
    assert (out.stat().st_ino == file) == late, "a map with its record stays"
    assert check_map(out).keyframes == 180


def _fleet(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three connected drives of 60 keyframes each; returns the path for their map."""
    _, maps, joins = fleet_maps(3)
    for name, data in maps.items():
        (folder / name).mkdir()
        save_as(data, folder / name / MAP)
    monkeypatch.setattr("dpm2_core.fleet.merge.Search", lambda *arguments: Found(folder, maps, joins))
    (folder / "out").mkdir()
    return folder / "out" / "town"


def _interrupt() -> None:
    """Acts as Ctrl-C while Ray ends."""
    raise KeyboardInterrupt


@pytest.mark.parametrize("replaced", [False, True])
def test_a_drive_that_was_added_to_a_merge_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, replaced: bool
) -> None:
    """A merge is rejected if its map contains a drive that was added by `dpm2 run --extend`, or (`replaced`) if it is a
    different map, next to an older merge's record."""
    out = _fleet(tmp_path, monkeypatch)
    merge(tmp_path, out, SlamSettings(), nullcontext())
    if replaced:
        out.unlink()
    with MapStore.create(out) if replaced else MapStore.open(out, read_only=False) as store:
        append_map(store, ring(5))
    before = out.read_bytes()
    with pytest.raises(
        UsageError, match=f"town: 5 of its keyframes are of no drive in {tmp_path}; choose another --out"
    ):
        merge(tmp_path, out, SlamSettings(), nullcontext())
    assert out.read_bytes() == before


def test_a_log_that_a_map_was_moved_without_is_not_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the log of a moved map is at the target, the merge is rejected. Previously, the last keyframes of that map,
    whose drive was killed, were lost with its log."""
    out = _fleet(tmp_path, monkeypatch)
    log = out.with_name(f"{out.name}-wal")
    log.write_bytes(bytes(5000))
    with pytest.raises(UsageError, match="town-wal: the last keyframes of a map that was moved"):
        merge(tmp_path, out, SlamSettings(), nullcontext())
    assert log.read_bytes() == bytes(5000)
    assert not out.exists()


@pytest.mark.parametrize("drives", ['["a"]', '{"a": "x"}', "{"])
def test_a_map_whose_record_is_damaged_is_not_replaced(tmp_path: Path, drives: str) -> None:
    save_as(ring(3), tmp_path / "town")
    (tmp_path / "town.json").write_text(f'{{"drives": {drives}, "left_out": {{}}, "joins": [], "made": {{}}}}')
    with pytest.raises(UsageError, match="and is no merge of drives"):
        merge(tmp_path, tmp_path / "town", SlamSettings(), Cluster())


class Stopped(Cluster):
    """One part ends, then Ctrl-C follows."""

    def run(self, parts: Iterable[Part], out: Path, watch: object = None) -> Iterator[Outcome]:
        weights = SlamSettings().weights_id()
        yield Outcome(next(iter(parts)).name, "done", {"keyframes": 60, "weights": [weights]})
        raise KeyboardInterrupt


def test_a_merge_that_is_stopped_leaves_no_drive_out(tmp_path: Path) -> None:
    """An interrupted merge writes no map. Previously, a map of only the drives that had been processed replaced the map
    of all."""
    for name, data in fleet_maps(3)[1].items():
        (tmp_path / name).mkdir()
        save_as(data, tmp_path / name / MAP)
        (tmp_path / name / DONE).write_text('{"files": {}}')
    with pytest.raises(KeyboardInterrupt):
        merge(tmp_path, tmp_path / "town", SlamSettings(), Stopped())
    assert not (tmp_path / "town").exists()


class AtOnce(Cluster):
    """Runs its parts in this process, until one is interrupted."""

    def run(self, parts: Iterable[Part], out: Path, watch: Watch = lambda status: None) -> Iterator[Outcome]:
        for part in parts:
            try:
                yield Outcome(part.name, "done", do_part(part, out))
            except Dpm2Error as error:
                yield Outcome(part.name, "failed", reason=str(error))


def leave_a_map(folder: Path, advance: Advance, voxel: float, end: str) -> Figures:
    """The work of a part: writes all that a merge reads, or fails."""
    if end == "stopped":
        raise KeyboardInterrupt
    if end == "failed":
        raise Dpm2Error("no such recording")
    (folder / MAP).write_text(f"{voxel}")
    return {}


def test_maps_of_settings_that_were_given_up_are_not_joined_with_the_new_ones(tmp_path: Path) -> None:
    """Previously, drives that failed or were not reached with new settings still had their old maps, and these were
    joined with the maps of the new settings without a message."""

    def run(voxel: float, ends: dict[str, str]) -> list[str]:
        work = f"{__name__}:leave_a_map"
        parts = [Part(name, work, {"voxel": voxel, "end": end}, fresh=True) for name, end in ends.items()]
        return [outcome.state for outcome in carry_out(parts, tmp_path, AtOnce())]

    def joined() -> tuple[list[str], dict[str, str]]:
        left_out: dict[str, str] = {}
        return list(Search(tmp_path, SlamSettings(), Cluster(), View()).drives(left_out)), left_out

    assert run(0.2, {"a": "", "b": "", "c": ""}) == ["done"] * 3
    assert joined() == (["a", "b", "c"], {})
    assert run(0.4, {"a": "", "b": "failed", "c": "stopped"}) == ["done", "failed", "stopped"]
    names, left_out = joined()
    assert names == ["a"]
    assert left_out["b"] == "not complete in the last run: no such recording"
    assert left_out["c"] == "not complete in the last run: stopped"
    assert run(0.2, {"b": "", "c": ""}) == ["kept", "kept"]
    assert joined()[0] == ["a", "b", "c"]


def describe_as(folder: Path, name: str, vectors: Vector) -> Vector:
    """Write the vectors of a drive's places where its part does."""
    (folder / "places" / name).mkdir(parents=True)
    np.save(folder / "places" / name / "places.npy", vectors)
    return vectors


class Described(Cluster):
    """A cluster for which the places of every drive exist already."""

    def run(self, parts: Iterable[Part], out: Path, watch: Watch = lambda status: None) -> Iterator[Outcome]:
        for part in parts:
            yield Outcome(part.name, "done", {"keyframes": 50, "weights": [SlamSettings().weights_id()]})


def test_a_drive_under_two_names_is_joined_once(tmp_path: Path, noise: np.random.Generator) -> None:
    """A copied recording is left out. Previously, it was in the map twice, joined with itself, without a message."""
    search = Search(tmp_path, SlamSettings(), Described(), View())
    parts = {name: Part(f"places/{name}", "", {"version": [1, 2]}, fresh=True) for name in "abc"}
    one, other = noise.normal(size=(2, 50, WIDTH)).astype(np.float32)
    for name, vectors in zip("abc", (one, one, other), strict=True):
        describe_as(search.kept, name, vectors)
    left_out: dict[str, str] = {}
    assert list(search.places(parts, left_out)) == ["a", "c"]
    assert left_out == {"b": "the same drive as a: all its places are the same"}


def test_places_are_found_again_in_an_index_that_was_kept(tmp_path: Path, noise: np.random.Generator) -> None:
    """This includes an index that was truncated, which is ignored."""
    pytest.importorskip("faiss", reason="no faiss: pip install 'dpm2_ros[fleet]'")
    drives = [noise.normal(size=(50, WIDTH)).astype(np.float32) for _ in range(2)]
    drives[1][7] = 0  # a keyframe without descriptors
    again = drives[0] + 0.05 * noise.normal(size=(50, WIDTH)).astype(np.float32)
    index = FleetIndex(tmp_path)
    assert (index.similar(again, 3) == -1).all()
    for name, vectors in zip("ab", drives, strict=True):
        index.add(name, [1, 2], describe_as(tmp_path, name, vectors))
    index.save()
    kept = FleetIndex(tmp_path)
    assert kept.drives == [("a", [1, 2], 50), ("b", [1, 2], 50)]
    np.testing.assert_array_equal(kept.similar(again, 3)[:, 0], np.arange(50))
    assert (kept.similar(drives[1], 3)[7] == -1).all()
    file = tmp_path / "places" / "b" / "places.npy"
    file.write_bytes(file.read_bytes()[:1000])
    assert not FleetIndex(tmp_path).drives


def test_candidates_that_are_gone_are_looked_for_anew(tmp_path: Path, noise: np.random.Generator) -> None:
    """Damaged ones are an error that names the file to remove."""
    pytest.importorskip("faiss", reason="no faiss: pip install 'dpm2_ros[fleet]'")
    search = Search(tmp_path, SlamSettings(), Cluster(), View())
    parts = {name: Part(f"places/{name}", "", {"version": [1, 2]}) for name in "ab"}
    for name in parts:
        describe_as(search.kept, name, noise.normal(size=(50, WIDTH)).astype(np.float32))
    search.index(parts)
    file = search.kept / "candidates" / "b.json"
    found = file.read_text()
    file.unlink()
    index = search.index(parts)
    assert file.read_text() == found
    assert index.drives == [("a", [1, 2], 50), ("b", [1, 2], 50)]
    file.write_text(found[:100])
    with pytest.raises(Dpm2Error, match=r"b.json: damaged; remove the folder .*/.merge, and it is made again"):
        search.joins(parts, index)
    listed = search.kept / "index.json"
    listed.write_text(listed.read_text().replace("50", "-50"))
    assert not FleetIndex(search.kept).drives


def test_late_places_and_those_in_the_graph_are_found_alike(
    tmp_path: Path, noise: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This holds for any order, and for a kept or damaged index; an index whose saving was interrupted continues."""
    pytest.importorskip("faiss", reason="no faiss: pip install 'dpm2_ros[fleet]'")
    monkeypatch.setattr("dpm2_core.fleet.places._MAX_OUTSIDE_GRAPH", 120)
    drives = [noise.normal(size=(50, WIDTH)).astype(np.float32) for _ in range(5)]
    again = [vectors + 0.05 * noise.normal(size=vectors.shape).astype(np.float32) for vectors in drives]

    def check(index: FleetIndex, count: int) -> None:
        for number in range(count):
            np.testing.assert_array_equal(index.similar(again[number], 3)[:, 0], np.arange(50) + 50 * number)
        rows = index.similar(again[0], 40)
        assert all(len(set(row)) == 40 for row in rows.tolist())  # none is found twice

    index, file, listed = FleetIndex(tmp_path), tmp_path / "index.json", b""
    for number, vectors in enumerate(drives[:4]):
        index.add(f"d{number}", [0], describe_as(tmp_path, f"d{number}", vectors))
        index.save()
        if number == 2:
            whole = file.read_bytes()
            file.write_bytes(listed)  # as after a kill when the graph was written, but not the list
            index = FleetIndex(tmp_path)
            assert len(index.drives) == 2
            check(index, 2)
            file.write_bytes(whole)
        index, listed = FleetIndex(tmp_path), file.read_bytes()
        if number > 1:
            check(index, number + 1)
    graph = (tmp_path / "index.faiss").read_bytes()
    index.add("d4", [0], describe_as(tmp_path, "d4", drives[4]))
    check(index, 5)
    index.save()
    check(FleetIndex(tmp_path), 5)
    for damaged in (graph[:1000], b""):
        (tmp_path / "index.faiss").write_bytes(damaged)
        check(FleetIndex(tmp_path), 5)
    (tmp_path / "index.faiss").unlink()
    check(FleetIndex(tmp_path), 5)
    index = FleetIndex(tmp_path)
    index.clear()
    index.add("d0", [1], drives[0])
    index.save()
    assert FleetIndex(tmp_path).drives == [("d0", [1], 50)]
    check(FleetIndex(tmp_path), 1)


def test_stretches_hold_what_looks_alike_and_leave_out_single_keyframes() -> None:
    pairs = np.array([[3, 10], [40, 60], [4, 11], [5, 11], [5, 12], [90, 13]])
    (found,) = stretches("a", "b", pairs)
    assert found.other_nodes == (10, 11, 12, 13)
    assert {3, 4, 5, 90} <= set(found.one_nodes)
    assert 40 not in found.one_nodes
    long = np.stack([np.arange(100), np.arange(100)], 1)
    assert max(len(stretch.other_nodes) for stretch in stretches("a", "b", long)) <= 41
