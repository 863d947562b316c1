# SPDX-License-Identifier: Apache-2.0
"""A fleet on a real Ray cluster: results equal those of `dpm2 run`, and a fault affects only its own drive."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dpm2_core.errors import UsageError
from dpm2_core.fleet import cluster as ray_cluster
from dpm2_core.fleet.cluster import Cluster
from dpm2_core.fleet.drives import MAP, ManifestDrive, parts_of, read_drives
from dpm2_core.fleet.part import Part
from dpm2_core.fleet.run import SUMMARY, carry_out
from dpm2_core.fleet.sweep import sweep_parts, variants
from dpm2_core.slam.store.check import check_map
from dpm2_core.slam.store.map_store import MapStore

from ...helpers.command import dpm2
from ...helpers.drives import first_scans

FAST = ["slam.registration=geometric", "slam.loops.descriptors=false", "slam.threads=1"]
SET = [word for setting in FAST for word in ("--set", setting)]
SAME = ("trajectory_kitti.txt", "trajectory.tum", "map.ply", "pose_graph.g2o", "loops.csv", "config.yaml")
WORK = """
import os
import resource
import signal
from dpm2_core.fleet import drives

def full_disk(folder, advance, **arguments):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        return drives.run_drive(folder, advance, **arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

def killed_once(folder, advance, **arguments):
    marker = folder.parent / "killed"
    def dying(done, total):
        if done == 6 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return drives.run_drive(folder, dying, **arguments)

def divide(folder, advance, value):
    if value < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"quotient": 10 // value}
"""
"""A drive on a disk where no file can exceed 50 kB; a drive whose first worker dies half-way; a work that kills its
worker, has a bug, or neither."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Two workers, which every command of this module uses; they can import `fleet_work`."""
    pytest.importorskip("ray", reason="no ray: pip install 'dpm2_ros[fleet]'")
    folder = tmp_path_factory.mktemp("work")
    (folder / "fleet_work.py").write_text(WORK)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
        with Cluster(workers=2) as cluster:
            cluster.start()
            yield cluster


@pytest.fixture(scope="module")
def drives(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two drives of 12 scans, and a folder that is not a drive."""
    root = tmp_path_factory.mktemp("drives")
    (root / "nothing").mkdir()
    return [*(first_scans(recording, 12, root / name) for name in ("one", "two")), root / "nothing"]


@pytest.fixture(scope="module")
def alone(drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of `dpm2 run` on the first drive."""
    out = tmp_path_factory.mktemp("alone")
    assert dpm2("run", drives[0], "--out", out, "--map", out / MAP, *SET).returncode == 0
    return out


def equal(one: Path, other: Path) -> None:
    """Every file without times is equal byte for byte, and so is every row of the maps."""
    for name in SAME:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    with MapStore.open(one / MAP) as a, MapStore.open(other / MAP) as b:
        for table in ("keyframes", "payloads", "edges", "poses", "moving", "trail"):
            assert list(a.rows(table)) == list(b.rows(table)), table


def test_without_ray_or_without_its_cluster_one_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    done = dpm2("fleet", "run", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "pip install 'dpm2_ros[fleet]'" in done.stderr
    monkeypatch.undo()
    ray = pytest.importorskip("ray", reason="no ray: pip install 'dpm2_ros[fleet]'")
    if ray.is_initialized():
        pytest.skip("this process is connected to a cluster, which is then used")
    with pytest.raises(UsageError, match=r"^--ray 127\.0\.0\.1:9: no answer from this address"):
        Cluster("127.0.0.1:9").start()

    def slow(*arguments: object, **more: object) -> None:
        raise Exception("The current node timed out\n during startup.")  # as Ray does after 30 s

    monkeypatch.setattr(ray, "init", slow)
    monkeypatch.setattr(tempfile, "tempdir", "/tmp")
    with subprocess.Popen("true") as ended:
        pass
    left = Path(f"/tmp/.ray.{ended.pid}.part")  # as left by a fleet that was killed
    left.mkdir()
    with pytest.raises(UsageError, match=r"^Ray: The current node timed out during startup\.$"):
        Cluster().start()
    assert not left.exists()
    assert not Path(f"/tmp/.ray.{os.getpid()}.part").exists()


@pytest.mark.slow
def test_a_fleet_gives_what_runs_give_and_goes_on_where_it_was(
    cluster: Cluster, drives: list[Path], alone: Path, tmp_path: Path
) -> None:
    """A drive that cannot be read is named; complete results are kept, damaged ones are made again."""
    out = tmp_path / "out"
    done = dpm2("fleet", "run", *drives, "--out", out, *SET)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("dpm2: 1 of 3 failed: nothing")
    summary = {row["name"]: row for row in json.loads((out / SUMMARY).read_text())["drives"]}
    assert {name: row["state"] for name, row in summary.items()} == {"one": "done", "two": "done", "nothing": "failed"}
    assert str(drives[2]) in summary["nothing"]["reason"]
    assert summary["one"]["figures"]["frames"] == 12
    assert sorted(path.name for path in out.iterdir()) == [SUMMARY, "one", "two"], "nothing half-written is left"
    equal(out / "one", alone)
    equal(out / "two", alone)  # the same scans
    assert not check_map(out / "two" / MAP).problems
    before = (out / "one" / MAP).stat().st_mtime_ns
    (out / "two" / "map.ply").write_bytes((out / "two" / "map.ply").read_bytes()[:100])
    assert dpm2("fleet", "run", *drives[:2], "--out", out, *SET).returncode == 0
    again = json.loads((out / SUMMARY).read_text())["drives"]
    assert [row["state"] for row in again] == ["kept", "done"]
    assert (out / "one" / MAP).stat().st_mtime_ns == before
    equal(out / "two", alone)


@pytest.mark.slow
def test_a_sweep_has_a_row_for_each_combination(cluster: Cluster, drives: list[Path], tmp_path: Path) -> None:
    """Each equals a single run; a combination that fails on a drive is counted, and compared on the other drives
    only."""
    config, out = tmp_path / "config.yaml", tmp_path / "out"
    config.write_text("slam: {registration: geometric, threads: 1, loops: {descriptors: false}}")
    values = ["--set", "slam.map.voxel=0.3,0.6", "--set", "slam.preprocess.max_range=30,60"]
    done = dpm2("fleet", "sweep", drives[0], drives[2], "--out", out, "--config", config, *values)
    assert done.returncode == 1
    assert "means over 1 of 2 drives" in done.stdout
    rows = json.loads((out / SUMMARY).read_text())["drives"]
    assert sum(row["state"] == "done" for row in rows) == sum(row["state"] == "failed" for row in rows) == 4
    maps = {len((out / row["name"] / "map.ply").read_bytes()) for row in rows if row["state"] == "done"}
    assert len(maps) == 4, "the settings made no difference"


@pytest.mark.parametrize(("settings", "words"), [
    (["slam.map.voxel"], "want KEY=VALUE,VALUE"),
    (["slam.map.voxel=1,,2"], "want KEY=VALUE,VALUE"),
    (["a=1", "a=2"], "given twice"),
])  # fmt: skip
def test_a_sweep_of_nothing_is_an_error_of_use(settings: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        variants(settings)


def test_a_drive_with_its_own_value_of_what_is_swept_is_an_error_of_use(tmp_path: Path) -> None:
    """A drive's own value would take precedence, so that all its rows were equal, as if the setting made no
    difference."""
    drives = [ManifestDrive(path="x", name="x", set=("slam.map.voxel=0.3", "slam.keyframes.distance = 5"))]
    with pytest.raises(UsageError, match=r"^x: the list has slam\.keyframes\.distance = 5 for it"):
        list(sweep_parts(drives, tmp_path / "base.yaml", variants(["slam.keyframes.distance=4,6"])))


def test_values_of_a_sweep_may_be_lists() -> None:
    found = variants(["input.T=[1,2],[3,4]", "slam.neural.weights=a/b,c"])
    assert list(found) == [f"input.T={T} slam.neural.weights={w}" for T in ("[1,2]", "[3,4]") for w in ("a%2Fb", "c")]
    assert found["input.T=[3,4] slam.neural.weights=a%2Fb"] == ["input.T=[3,4]", "slam.neural.weights=a/b"]


@pytest.mark.parametrize(("one", "other"), [
    ("slam.keyframes.distance=4", "slam.map.redundancy=4"),
    ("slam.neural.weights=w/a_b.npz", "slam.neural.weights=w_a/b.npz"),
    ("slam.neural.weights=a/b", "slam.neural.weights=a%2Fb"),
])  # fmt: skip
def test_other_settings_have_another_folder(one: str, other: str) -> None:
    """Otherwise the second of two sweeps would replace the runs of the first, or one of two such values would be left
    out."""
    assert not variants([one]).keys() & variants([other]).keys()


def test_the_folder_of_a_setting_is_one_name() -> None:
    (name,) = variants(["slam.neural.weights=/w/a.npz"])
    assert Path(name).name == name


@pytest.mark.slow
def test_faults_cost_only_what_they_hit(cluster: Cluster, drives: list[Path], alone: Path, tmp_path: Path) -> None:
    """A worker that is killed with -9 is replaced; a full disk leaves no drive behind; all in one fleet."""
    parts = parts_of(read_drives(drives[:2]), None, FAST)
    names = ("killed_once", "full_disk")
    parts = [replace(part, work=f"fleet_work:{name}") for part, name in zip(parts, names, strict=True)]
    out = tmp_path / "out"
    whole, full = carry_out(parts, out, Cluster())
    assert (whole.state, full.state) == ("done", "failed")
    assert any(words in full.reason for words in ("File too large", "disk", "full")), full.reason
    equal(out / "one", alone)
    assert sorted(path.name for path in out.iterdir()) == [SUMMARY, "killed", "one"]


@pytest.mark.long
def test_what_kills_every_worker_ends_with_a_reason(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bug is reported as one line with its position; the other parts continue."""
    monkeypatch.setattr(ray_cluster, "MEMORY", 10**15)  # bytes that no machine has
    parts = [Part(str(value), "fleet_work:divide", {"value": value}) for value in (-1, 0, 2)]
    found = {ended.name: ended for ended in cluster.run(parts, tmp_path)}
    assert (found["2"].figures or {})["quotient"] == 5
    assert found["-1"].reason.startswith("3 workers died while processing it")
    assert found["0"].reason.startswith("ZeroDivisionError: ")
    assert "fleet_work.py:" in found["0"].reason


def test_drives_of_a_manifest_have_names_and_settings_of_their_own(tmp_path: Path) -> None:
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text(
        "drives: [{path: a/00}, {path: b/00, name: b00, frames: '5:9', gt: true.txt, set: [slam.threads=3]}]"
    )
    parts = parts_of(read_drives([manifest]), None, ["slam.registration=geometric"])
    assert [part.name for part in parts] == ["00", "b00"]
    assert parts[1].arguments["path"] == str(tmp_path / "b" / "00")
    assert parts[1].arguments["gt"] == str(tmp_path / "true.txt")
    assert parts[1].arguments["frames"] == (5, 9)
    assert [part.cores for part in parts] == [1, 3]
    assert parts[0].arguments["config"].slam.registration == "geometric"


@pytest.mark.parametrize(("text", "words"), [
    ("drives: []", "drives"),
    ("drives: [{path: a, speed: 3}]", "speed"),
    ("drives: [{path: a}, {path: b/a}]", "both would have the name a"),
    ("drives: [{path: a, name: ../b}]", "cannot be the name of a folder"),
    ("drives: [{path: a, frames: x}]", "want a:b"),
])  # fmt: skip
def test_a_bad_manifest_is_an_error_of_use(text: str, words: str, tmp_path: Path) -> None:
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text(text)
    done = dpm2("fleet", "run", manifest, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert words in done.stderr
    assert not (tmp_path / "out").exists()


def test_weights_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(Path(__file__), "own.safetensors")
    (part,) = parts_of(read_drives([Path("00")]), None, ["slam.neural.weights=own.safetensors"])
    config: Any = part.arguments["config"]
    assert config.slam.neural.weights == str(tmp_path / "own.safetensors")
    assert part.inputs == [tmp_path / "own.safetensors"]


def test_a_drive_is_done_again_when_the_weights_of_its_filter_or_its_truth_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(Path(__file__), "own.safetensors")
    Path("fleet.yaml").write_text("drives: [{path: a, gt: poses.txt}]")
    of_filter = ["slam.filter.kind=movers", "slam.filter.weights=own.safetensors"]
    (part,) = parts_of(read_drives([Path("fleet.yaml")]), None, [*FAST, *of_filter])
    config: Any = part.arguments["config"]
    assert config.slam.filter.weights == tmp_path / "own.safetensors"
    assert part.inputs == [tmp_path / "own.safetensors", tmp_path / "poses.txt"]


@pytest.mark.long
def test_a_cluster_of_this_machine_is_not_reached_from_others(tmp_path: Path) -> None:
    """In a separate process, as a command is: Ray reads the address to listen on only once, when it is imported."""
    pytest.importorskip("ray", reason="no ray: pip install 'dpm2_ros[fleet]'")
    program = """
from dpm2_core.fleet.cluster import Cluster
with Cluster(workers=1) as cluster:
    cluster.start()
    import os, ray
    print([node["NodeManagerAddress"] for node in ray.nodes()], "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER" in os.environ)
"""
    home = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], env=home, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["['127.0.0.1']", "False"]
    assert (tmp_path / ".ray").stat().st_mode & 0o77 == 0
    assert (tmp_path / ".ray" / "auth_token").is_file()
