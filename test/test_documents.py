# SPDX-License-Identifier: Apache-2.0
"""Measured figures in the documents are those of the records in benchmarks/, and the modules that they name exist."""

from __future__ import annotations

import re

import pytest

from .helpers.documents import ROOT, equals, record, rows, text

DOCS = (ROOT / "docs").glob("*.md")
CARD, MEASURED = "dpm2_core/weights/small.md", "docs/measured.md"
METHODS = {
    "dpm2, odometry": "dpm2 without loops",
    "dpm2, with loops by descriptors": "dpm2",
    "KISS-ICP": "kiss-icp",
    "neural": "neural",
    "refined": "refined",
    "geometric": "geometric",
}


def test_the_figures_beside_kiss_icp_are_those_of_the_record() -> None:
    heading = "| drive | method | RPE m | RPE deg | ATE m | t_err % | drift % | frames/s | CPU ms per frame |"
    keys = ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m", "t_err_percent", "final_drift_percent", "fps", "cpu_ms")
    drives, seen, drive = record("geometric.json")["drives"], [], ""
    for cells in rows(MEASURED, heading):
        drive = cells[0].partition(",")[0] or drive
        method = METHODS[cells[1]]
        seen.append((drive, method))
        for key, cell in zip(keys, cells[2:], strict=True):
            assert equals(cell.strip("*"), drives[drive][method][key]), (drive, method, key)
    assert sorted(seen) == sorted((d, m) for d in drives for m in METHODS.values() if m in drives[d])


def test_the_figures_beside_wheels_are_those_of_the_record() -> None:
    worlds, seen = record("beside.json")["worlds"], []
    for world, *cells in rows(MEASURED, "| | without wheels | that slip | that slip and jump |"):
        seen.append(world)
        for kind, cell in zip(("own", "slip", "slip and jump"), cells, strict=True):
            assert equals(cell, worlds[world][kind]["ape_rmse_m"]), (world, kind)
    assert seen == list(worlds)


def test_the_figures_at_few_frames_per_second_are_those_of_the_record() -> None:
    methods = {"adaptive": "adaptive", "neural": "neural", "points alone": "geometric", "KISS-ICP": "kiss-icp"}
    drives, drive, seen = record("hard.json")["drives"], "", 0
    for cells in rows(MEASURED, "| drive | method | every frame | 3rd | 6th | 10th |"):
        drive = cells[0] or drive
        (method,) = (key for words, key in methods.items() if words in cells[1])
        for every, cell in zip((1, 3, 6, 10), cells[2:], strict=True):
            assert equals(cell, drives[drive][f"every {every}"][method]["rpe_trans_m"]), (drive, method, every)
        seen += 1
    real = [name for name in drives if name.isdigit()]
    assert seen == len(real) * len(methods)
    rates = [drives[name][f"every {every}"] for name in real for every in (1, 3, 6, 10)]
    assert all(rate["adaptive"]["failed_frames"] == 0 for rate in rates)


def test_the_figures_in_fog_are_those_of_the_record() -> None:
    methods, marks = (
        {"adaptive": "adaptive", "points alone": "geometric", "KISS-ICP": "kiss-icp"},
        {"!": "silent", "?": "said"},
    )
    drives = record("hard.json")["drives"]
    found = list(rows(MEASURED, "| in fog | 00 | 04 | city | suburb |"))
    assert len(found) == len(methods)
    for cells in found:
        (method,) = (key for words, key in methods.items() if words in cells[0])
        for drive, cell in zip(("00", "04", "city", "suburb"), cells[1:], strict=True):
            figures, (error, _, mark) = drives[drive]["fog 20 m"][method], cell.partition(" ")
            assert equals(error, figures["error_m"]), (method, drive)
            assert marks.get(mark, "right") == figures["verdict"], (method, drive)


def test_the_figures_of_sweeps_in_motion_are_those_of_the_record() -> None:
    rides, seen = record("motion.json")["rides"], []
    for name, *cells in rows(MEASURED, "| ride | dpm2 | dpm2, points alone | KISS-ICP |"):
        seen.append(name)
        for method, cell in zip(("dpm2", "dpm2 geometric", "kiss-icp"), cells, strict=True):
            meters, degrees = cell.split(", ")
            assert equals(meters, rides[name][method]["rpe_m"]), (name, method)
            assert equals(degrees, rides[name][method]["rpe_deg"]), (name, method)
    assert seen == list(rides)


def test_the_figures_of_the_livox_are_those_of_the_record() -> None:
    methods = {"dpm2, `adaptive`": "adaptive", "dpm2, `neural`": "neural", "KISS-ICP": "kiss-icp"}
    (cases,) = record("livox.json")["drives"].values()
    found = rows(MEASURED, "| one scan every | 0.5 s | 1.5 s | 3 s | 5 s |")
    assert [cells[0] for cells in found] == list(methods)
    for cells in found:
        for every, cell in zip((1, 3, 6, 10), cells[1:], strict=True):
            assert equals(cell, cases[f"every {every}"][methods[cells[0]]]["rpe_trans_m"]), (cells[0], every)
    assert [cases[f"every {every}"]["adaptive"]["failed_frames"] for every in (1, 3, 6, 10)] == [0, 0, 2, 2]
    interrupted = [case["adaptive"] for name, case in cases.items() if name.startswith(("gap", "blind"))]
    assert max(figures["error_m"] for figures in interrupted) < 0.045
    foggy = [case for name, case in cases.items() if name.startswith("fog")]
    assert max(case["adaptive"]["error_m"] for case in foggy) < 0.195
    assert [f"{case['kiss-icp']['error_m']:.0f}" for case in foggy] == ["20", "3"]
    assert cases["kidnapped"]["adaptive"]["verdict"] == "said"


def test_where_the_geometry_is_silent_the_figures_are_those_of_the_records() -> None:
    pairs, seen = record("neural.json")["parts"]["image"]["pairs"], []
    for cells in rows(MEASURED, "| | without camera | with | KISS-ICP |"):
        of = pairs[f"{cells[0]}, up to 5 m"]
        for cell, method in zip(cells[1:], ("refined without camera", "refined with camera", "kiss-icp"), strict=True):
            assert equals(cell.strip("* m"), of[method]["median_m"]), (cells[0], method)
        seen.append(cells[0])
    assert len(seen) == len(pairs)
    roads = record("relocalise.json")["open_roads"]
    found = re.findall(r"with an image (\d+) of (\d+) in the tunnel and (\d+) of (\d+) on the highway", text(MEASURED))
    of = [roads[road]["with images"] for road in ("tunnel", "highway")]
    assert [int(n) for n in found[0]] == [n for r in of for n in (round(r["right"] * r["visits"]), r["visits"])]
    assert [case["wrong"] for road in roads.values() for case in road.values() if isinstance(case, dict)] == [0] * 4


def test_the_times_of_a_relocalization_are_those_of_the_record() -> None:
    found = record("relocalise.json")
    (times,) = re.findall(r"without any prior in ([\d.]+) s \(p95 ([\d.]+)", text(MEASURED))
    assert all(equals(time, found["seconds"][key]) for time, key in zip(times, ("p50", "p95"), strict=True))
    (times,) = re.findall(r"cm in ([\d.]+) and ([\d.]+) s; the others are said", text(MEASURED))
    of = [found["open_roads"][road]["with images"]["seconds"]["p50"] for road in ("tunnel", "highway")]
    assert all(map(equals, times, of))


def test_the_figures_of_loops_and_of_the_solver_are_those_of_the_records() -> None:
    roads, graph = record("roads.json")["roads"].values(), record("pose-graph.json")
    kinds = [road["loops"][kind] for road in roads for kind in ("same", "reverse", "cross")]
    passed = r"(\d+) of the (\d+) places that are passed again are found, (\d+) of them"
    (counts,) = re.findall(passed, text(MEASURED))
    reverse = sum(road["loops"]["reverse"]["found"] for road in roads)
    assert [int(n) for n in counts] == [sum(k["found"] for k in kinds), sum(k["revisits"] for k in kinds), reverse]
    assert sum(road["loops"]["wrong"] for road in roads) == 0
    (shares,) = re.findall(r"error after loops is (\d+) to (\d+) % of that", text(MEASURED))
    left = [100 * road["slam"]["ape_rmse_m"] / road["odometry"]["ape_rmse_m"] for road in roads]
    assert equals(shares[0], min(left))
    assert equals(shares[1], max(left))
    (written,) = re.findall(
        r"in ([\d.]+) s: ATE ([\d.]+) m \(odometry ([\d.]+), plain least squares (\d+)\)", text(MEASURED)
    )
    most = graph["kitti_00"]["0.00"]
    of = (most["seconds"], most["ate_m"], most["odometry_ate_m"], most["least_squares"]["ate_m"])
    assert all(map(equals, written, of))


def test_bold_is_what_is_best() -> None:
    """The best value of each drive and figure is bold, and nothing else, because readers look at bold figures."""
    heading = "| drive | method | RPE m | RPE deg | ATE m | t_err % | drift % | frames/s | CPU ms per frame |"
    drives: dict[str, list[list[str]]] = {}
    for cells in rows(MEASURED, heading):
        drives.setdefault(cells[0] or list(drives)[-1], []).append(cells[2:])
    for table in drives.values():
        for number, column in enumerate(zip(*table, strict=True)):
            values = [float(cell.strip("*")) for cell in column]
            best = max(values) if number == 5 else min(values)
            assert [cell.startswith("**") for cell in column] == [value == best for value in values]


def test_where_kiss_icp_is_ahead_is_said() -> None:
    names = {"t_err_percent": "KITTI's metric", "ape_rmse_m": "the ATE", "final_drift_percent": "the drift"}
    (message,) = re.findall(r"KISS-ICP is slightly ahead in [^;]*;", text(MEASURED))
    drives = record("geometric.json")["drives"]
    for key in ("rpe_trans_m", "rpe_rot_deg", *names):
        ahead = [drive for drive, row in drives.items() if row["kiss-icp"][key] < row["dpm2 without loops"][key]]
        if ahead:
            where = "both drives" if len(ahead) == len(drives) else ahead[0]
            assert f"{names[key]} on {where}" in message, (key, ahead)
        else:
            assert names.get(key, "RPE") not in message


def test_the_card_has_the_figures_of_the_odometry() -> None:
    heading = "| drive | registration | RPE m, deg | ATE m | drift % | t_err % | ms per frame |"
    drives, seen = record("neural.json")["parts"]["odometry"]["drives"], 0
    for drive, registration, rpe, ate, drift, t_err, _ in rows(CARD, heading):
        true = drives[drive][METHODS[registration]]
        message = (*rpe.split(", "), ate, drift, t_err)
        keys = ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m", "final_drift_percent", "t_err_percent")
        for key, cell in zip(keys, message, strict=True):
            assert equals(cell, true[key]), (drive, registration, key)
        seen += 1
    assert seen == sum(map(len, drives.values()))


def test_what_refined_adds_on_these_drives_is_said() -> None:
    said = r"`refined` gives the poses of the points: its errors (?:equal|are) those of `geometric` to ([\d.]+) %"
    (within,) = {float(number) for path in (MEASURED, CARD) for number in re.findall(said, text(path))}
    assert within <= 0.5
    for methods in record("neural.json")["parts"]["odometry"]["drives"].values():
        for key in ("rpe_trans_m", "rpe_rot_deg", "ape_rmse_m", "final_drift_percent", "t_err_percent"):
            assert 100 * abs(methods["refined"][key] / methods["geometric"][key] - 1) <= within


def test_what_the_camera_adds_to_the_descriptors_is_said() -> None:
    ratios = record("neural.json")["parts"]["corruption"]["error_ratio"]
    (ratio,) = (value for name, value in ratios.items() if "camera" in name)
    (message,) = re.findall(r"every image black the shipped weights err ([\d.]+) times", text(MEASURED))
    assert equals(message, ratio)
    (message,) = re.findall(r"\| every image black[^|]*\| ([\d.]+) \|", text(CARD))
    assert equals(message, ratio)


@pytest.mark.parametrize("path", ["README.md", "CONTRIBUTING.md", "Makefile", *sorted(p.name for p in DOCS)])
def test_modules_that_are_named_exist(path: str) -> None:
    """A name with a folder must exist there, relative to the root, the core or the nodes; one without, anywhere. NAME
    stands for any name."""
    file = next(f for f in (ROOT / path, ROOT / "docs" / path) if f.is_file())
    names = re.findall(r"(?<![\w/.])((?:\w+/)*\w+\.py)\b", file.read_text(encoding="utf-8"))
    folders = (ROOT, ROOT / "dpm2_core", ROOT / "dpm2_ros")
    known = {f.name for part in ("dpm2_core", "dpm2_ros", "test") for f in (ROOT / part).rglob("*.py")}
    stale = [
        n for n in names if "NAME" not in n and n not in known and not any((folder / n).is_file() for folder in folders)
    ]
    assert not stale
    assert names or path != "architecture.md"


def test_the_first_table_of_the_readme_is_what_was_measured() -> None:
    cells = {
        row[2].split("](")[0].strip("["): row[1]
        for row in rows("README.md", "| what sets it apart | measured | where |")
    }
    found = record("relocalise.json")
    right, visits = round(found["right"] * found["visits"]), found["visits"]
    said = f"{right} of {visits} places found, {found['no_answer']} said to be unknown, none wrong"
    assert cells["relocalise"].endswith(said)
    assert found["wrong"] == 0
    tenth = record("hard.json")["drives"]["00"]["every 10"]
    ours, theirs = re.findall(r"([\d.]+) m\b", cells["hard"])
    assert equals(ours, tenth["adaptive"]["rpe_trans_m"])
    assert equals(theirs, tenth["kiss-icp"]["rpe_trans_m"])
    rides = {name: ride for name, ride in record("motion.json")["rides"].items() if not name.endswith(", car")}
    assert cells["motion"].startswith("seven")
    assert len(rides) == 7
    span = re.findall(r"(\d+) to (\d+) mm", cells["motion"])
    for method, (least, most) in zip(("dpm2", "kiss-icp"), span, strict=True):
        errors = [1e3 * ride[method]["rpe_m"] for ride in rides.values()]
        assert (round(min(errors)), round(max(errors))) == (int(least), int(most))
    gaps = [drive["adaptive"]["summary"]["all"] for drive in record("gaps.json")["drives"].values()]
    assert f"of {sum(drive['gaps'] for drive in gaps)} gaps" in cells["gaps"]
    assert sum(drive["silently_wrong"] for drive in gaps) == 0
    robots = record("robots.json")
    assert len(robots["robots"]) == 3
    assert (robots["packet_loss"], robots["outage"]["seconds"]) == (0.01, 30)
    assert all(robot["keyframes_missing"] == 0 for robot in robots["robots"].values())
    crash = record("map.json")["crash"]
    assert (crash["kills"], crash["maps_that_open"], crash["most_keyframes_lost"]) == (50, 50, 0)


def test_what_the_readme_says_in_short_is_what_was_measured() -> None:
    geometric, hard, readme = record("geometric.json")["drives"], record("hard.json")["drives"], text("README.md")

    def of(key: str, digits: int, method: str = "dpm2 without loops") -> str:
        return " and ".join(f"{geometric[drive][method][key]:.{digits}f}" for drive in ("00", "04"))

    kiss = {key: of(key, n, "kiss-icp") for key, n in (("rpe_trans_m", 3), ("cpu_ms", 0), ("t_err_percent", 2))}
    assert f"errs by {of('rpe_trans_m', 3)} m (KISS-ICP: {kiss['rpe_trans_m']} m) and takes" in readme
    assert f"takes {of('cpu_ms', 0)} ms of processor time ({kiss['cpu_ms']} ms)" in readme
    assert f"KISS-ICP is slightly ahead: {kiss['t_err_percent']} %, ours {of('t_err_percent', 2)} %" in readme
    tenth = [
        " and ".join(f"{hard[drive]['every 10'][method]['rpe_trans_m']:.3f}" for drive in ("00", "04"))
        for method in ("adaptive", "kiss-icp")
    ]
    assert f"10 and 14 m apart: {tenth[0]} m (KISS-ICP: {tenth[1]} m)" in readme
    pairs = record("neural.json")["parts"]["image"]["pairs"]["tunnel, up to 5 m"]
    tunnel = {name: figures["median_m"] for name, figures in pairs.items()}
    said = f"{tunnel['refined with camera']:.3f} m with a camera, {tunnel['refined without camera']:.2f} m without"
    assert f"{said} (KISS-ICP: {tunnel['kiss-icp']:.2f} m)" in readme
    kinds = [road["loops"] for road in record("roads.json")["roads"].values()]
    found, all_of_them = (
        sum(loops[kind][count] for loops in kinds for kind in ("same", "reverse", "cross"))
        for count in ("found", "revisits")
    )
    assert f"{found} of the {all_of_them} places that are passed again are found" in readme
    means = {row["name"]: row["cells"]["mean"]["t_err_percent"] for row in record("kitti.json")["tables"][0]["rows"]}
    beside = f"(KISS-SLAM: {means['kiss-slam']:.3f} %, KISS-ICP: {means['kiss-icp']:.3f} %)"
    assert f"{means['dpm2 adaptive']:.3f} % {beside}" in readme
    node = record("ros.json")["drives"]["04"]
    latency = f"{node['latency_p50_ms']:.0f} ms from a cloud to its pose (p95 {node['latency_p95_ms']:.0f} ms)"
    assert f"{latency}, and no cloud lost" in readme


def test_the_latencies_are_those_of_the_record() -> None:
    drives = record("ros.json")["drives"]
    for number, cells in enumerate(rows(MEASURED, "| from cloud to `/dpm2/odom`, median (p95) | 04 | simulated |")):
        for drive, cell in zip(("04", "00"), cells[1:], strict=True):
            of = drives[drive + ("", ", IMU and all topics")[number]]
            found = re.findall(r"\d+", cell)
            assert all(map(equals, found, (of["latency_p50_ms"], of["latency_p95_ms"]))), (drive, cell)
            assert of["dropped"] == 0
