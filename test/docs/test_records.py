# SPDX-License-Identifier: Apache-2.0
"""Tables and figures outside docs/measured.md, and its first tables on weights and truth, equal the records."""

from __future__ import annotations

import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

from dpm2_core.network.pretrained import weights_id
from tools import measure

from ..helpers.documents import ROOT, equals, record, rows, text

MEASURED, EXPERIMENTS, TRAFFIC = "docs/measured.md", "docs/experiments.md", "docs/traffic.md"
WEIGHTS = "dpm2_core/weights/small.safetensors"
FAR = ("neural", "refined", "kiss-icp", "small_gicp", "neural, against fitted poses")


def test_the_figures_of_the_papers_ways_are_those_of_the_record() -> None:
    methods = {
        "ours": "ours",
        "start from the most confident pairs": "start: most confident pairs",
        "nearest keyframe": "nearest keyframe",
        "nearest keyframe, then scan to map": "nearest keyframe, then scan to map",
        "keyframes by the residual": "keyframes by residual",
        "loops by the overlap head": "loops by the overlap head",
        "all of the paper's": "the paper's",
    }
    drives = record("paper.json")["drives"]
    found = list(rows(EXPERIMENTS, "| | 00 | 04 | suburb |"))
    assert [cells[0] for cells in found] == list(methods)
    for name, *cells in found:
        for drive, cell in zip(("00", "04", "suburb"), cells, strict=True):
            of = drives[drive][methods[name]]
            assert all(map(equals, cell.split(" / "), (of["rpe_trans_m"], of["final_drift_percent"]))), (name, drive)


def test_what_is_said_of_the_papers_ways_is_in_the_record() -> None:
    drives, said = record("paper.json")["drives"], text(EXPERIMENTS)
    failed = {(d, m): of["failed_frames"] for d, drive in drives.items() for m, of in drive.items()}
    suburb, paper = drives["suburb"], "the paper's"
    assert [key for key, count in failed.items() if count] == [("suburb", paper)]
    counts = f"{suburb[paper]['failed_frames']} of the {suburb[paper]['frames']} of the suburb"
    assert f"Every frame is registered, except {counts} with all of the paper's methods" in said
    loops = {method: of["loops"] for method, of in suburb.items()}
    tried = loops["start: most confident pairs"]
    assert f"none of the {tried['tried']} loops that are tried in the suburb is accepted" in said
    assert tried["accepted"] == 0
    assert sum(of["loops"]["wrong"] for drive in drives.values() for of in drive.values()) == 0
    (written,) = re.findall(
        r"alone are off by ([\d.]+) m \(median\), those that the points verify by ([\d.]+) to ([\d.]+) m, "
        r"those with all of the paper's methods by ([\d.]+) m",
        said,
    )
    medians = {method: of["error_m"]["median"] for method, of in loops.items() if of["error_m"]}
    head, last = medians.pop("loops by the overlap head"), medians.pop(paper)
    assert all(map(equals, written, (head, min(medians.values()), max(medians.values()), last)))


def test_the_shares_of_reference_points_that_meet_again_are_those_of_the_record() -> None:
    shares = {
        drive.removeprefix("simulated "): {kind: 100 * of["1 apart"]["0.2 m"] for kind, of in kinds.items()}
        for drive, kinds in record("neural.json")["parts"]["reference"]["shares"].items()
    }
    said = text("docs/sensors.md")

    def span(kind: str, *drives: str) -> str:
        of = sorted({f"{shares[drive][kind]:.0f}" for drive in drives}, key=int)
        return " to ".join(dict.fromkeys((of[0], of[-1])))

    farthest, edges, corners = "farthest points", "salient", "salient, with images"
    towns, bare = ("00", "04", "city", "suburb", "rural"), ("tunnel", "highway")
    assert f"In town and country {span(farthest, *towns)} % of the farthest points do" in said
    assert f"and {span(edges, *towns)} % with points on vertical edges and poles" in said
    assert f"in a car park {span(farthest, 'car_park')} and {span(edges, 'car_park')} %" in said
    assert f"hardly any edges, and it is {span(farthest, *bare)} and {span(edges, *bare)} %" in said
    roads = span(corners, "city", "suburb", "rural", *bare)
    assert f"it is {roads} % on all simulated roads and {span(corners, '04')} % on 04" in said
    assert {f"Indoors it is {share:.0f} % with any of them" in said for share in shares["indoor"].values()} == {True}
    times = [shares[drive][edges] / shares[drive][farthest] for drive in towns]
    assert f"{min(times):.0f} to {max(times):.0f} times as often in town and country" in text(EXPERIMENTS)


@cache
def blob(commit: str) -> str:
    """Git's hash of the weights at a commit; empty if this checkout does not have the commit."""
    command = ["git", "rev-parse", "--verify", "--quiet", f"{commit.rstrip('+')}:{WEIGHTS}"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.strip()


def test_the_weights_of_each_record_are_those_at_its_commit(tmp_path: Path) -> None:
    """They are the shipped ones, or others with the same encoder, as far as this checkout has the history."""
    listed = [re.findall(r"`([\w-]+)`", cells[0]) for cells in rows(MEASURED, "| records | weights at their commit |")]
    at = {path.stem: blob(record(path.name)["commit"]) for path in sorted((ROOT / "benchmarks").glob("*.json"))}
    at = {name: of for name, of in at.items() if of}
    if not at:
        pytest.skip("no history of git")

    def digest(of: str) -> str:
        path = tmp_path / "small.safetensors"
        path.write_bytes(subprocess.run(["git", "cat-file", "blob", of], cwd=ROOT, capture_output=True).stdout)
        return weights_id(str(path))

    command = ["git", "hash-object", WEIGHTS]
    shipped = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    same = {of for of in set(at.values()) if digest(of) == weights_id("small")}
    assert {name for name in listed[0] if name in at} == {name for name, of in at.items() if of == shipped}
    assert {name for name in listed[1] if name in at} == {n for n, of in at.items() if of in same - {shipped}}


def test_records_of_the_shipped_weights_are_measured_again_by_make_measure() -> None:
    """Thus no record of older weights remains after new weights."""
    first = next(rows(MEASURED, "| records | weights at their commit |"))
    assert set(re.findall(r"`([\w-]+)`", first[0])) <= {*measure.COMMANDS, *measure.TARGETS}


def test_the_share_of_far_pairs_that_are_found_is_that_of_the_record() -> None:
    """Each row states the poses that it is compared with."""
    drives = record("neural.json")["parts"]["real"]["drives"]
    heading = "| no prior, error below 0.6 m and 1.5 deg | neural | refined | KISS-ICP, small_gicp |"
    found = {cells[0]: cells[1:] for cells in rows(MEASURED, heading)}
    for distance in ("10-20 m", "20-30 m", "30-40 m"):
        kinds = {kind: [100 * drives[d][distance][kind]["success"] for d in ("00", "04")] for kind in FAR}
        neural, refined, kiss, gicp, fitted = (
            " / ".join(f"{share:.0f}" for share in of) + " %" for of in kinds.values()
        )
        words = distance.replace("-", " to ")
        assert found[f"real KITTI, {words} apart (00 / 04)"] == [neural, refined, "0 %"]
        assert kiss == gicp == "0 / 0 %"
        assert found[f"the same {words} against poses fitted to the scans"][0] == fitted


def test_the_figures_in_dense_traffic_are_those_of_the_record() -> None:
    filters = {
        "none": "none",
        "dynamic objects": "movers",
        "static (DSLR)": "static",
        "ground (GndNet)": "ground",
        "oracle": "true dynamic objects left out",
    }
    summary, registration, seen = record("traffic.json")["summary"], "", 0
    for cells in rows(TRAFFIC, "| registration | filter | RPE m | RPE deg | diverged | CPU ms per frame |"):
        registration = cells[0].removesuffix(" (the default)") or registration
        of = summary[registration][filters[cells[1]]]
        written = re.findall(r"[\d.]+", " ".join(cells[2:]))
        keys = ("median_rpe_m", "rpe_m", "median_rpe_deg", "rpe_deg", "diverged", "cpu_ms")
        assert all(map(equals, written, [of[key] for key in keys])), cells
        seen += 1
    assert seen == sum(map(len, summary.values()))


def test_the_times_of_the_filters_are_those_of_the_record() -> None:
    runs = [drive["runs"]["geometric"] for drive in record("traffic.json")["drives"].values()]
    (written,) = re.findall(
        r"`movers` takes (\d+) ms per frame of a core \(`static` (\d+), `ground` (\d+)\)", text(TRAFFIC)
    )
    for name, cell in zip(("movers", "static", "ground"), written, strict=True):
        assert equals(cell, sum(run[name]["filter_cpu_ms"] for run in runs) / len(runs)), name


def test_the_times_beside_kiss_icp_are_those_of_the_records() -> None:
    said = (
        r"takes ([\d.]+) times as long as KISS-ICP on KITTI 00 and ([\d.]+) times on 04 with its images; "
        r"elsewhere it works in float32 and takes ([\d.]+) and ([\d.]+) times as long"
    )
    (written,) = re.findall(said, text("docs/faq.md"))
    with_bf16, without = (
        [record(name)["parts"]["speed"]["drives"][drive]["ratio"] for drive in ("00", "04")]
        for name in ("neural.json", "neural_avx2.json")
    )
    assert all(map(equals, written, (*with_bf16, *without)))


def test_what_is_expected_of_a_large_fleet_follows_from_what_was_measured() -> None:
    fleet = record("fleet.json")
    index, whole = fleet["index"], fleet["whole"]
    graph = whole["cpu_s"]["graph"]
    table = {row[0]: row[1:] for row in rows("docs/fleet.md", "| | a keyframe | 2 million |")}
    into, look_up = re.findall(r"([\d.]+) ms", table["into the index of 200,000; a look-up there"][0])
    assert equals(into, 1000 * index["build_s"] / index["places"])
    assert equals(look_up, index["ms_a_query"]["index"])
    (solved,) = re.findall(r"([\d.]+) ms", table["pose graph, 20,000 at once"][0])
    assert equals(solved, 1000 * graph / whole["keyframes"])
    assert f"100 regions of {graph:.0f} s" in table["pose graph, 20,000 at once"][1]
