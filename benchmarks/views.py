# SPDX-License-Identifier: Apache-2.0
"""User interfaces: time that the live view adds to a run, and the page of a map in a browser."""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

from benchmarks.harness import Options, Report, configuration_of, drives, processors
from dpm2_core.console import progress_bar
from dpm2_core.data.source import Source
from dpm2_core.errors import Dpm2Error
from dpm2_core.evaluation.live_view import LiveView
from dpm2_core.evaluation.map_page import write_map_page
from dpm2_core.extras import needs
from dpm2_core.frame import Frame
from dpm2_core.pipeline import OfflineRun
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.store.map_data import load_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.system import SlamResult
from dpm2_core.tables import FigureTable, record_table
from tools.browser import SOFTWARE, chromium

_VOXEL = 0.3
"""Voxel size of the page, m: the default of `dpm2 map export`."""
_ROTATE_SCRIPT = """async () => {
  const canvas = document.querySelector("canvas"), at = (type, x) =>
    canvas.dispatchEvent(new PointerEvent(type, {clientX: x, clientY: 400, button: 0, pointerId: 1, bubbles: true}));
  canvas.setPointerCapture = () => {};
  at("pointerdown", 640);
  const begun = performance.now();
  for (let i = 0; performance.now() < begun + 4000; i++) {
    await new Promise(requestAnimationFrame);
    at("pointermove", 640 + 5 * i);
  }
  const rate = dpm2.rate;
  at("pointerup", 640);
  return rate;
}"""
"""The view is rotated in each frame for 4 s; the page itself counts frames per second while it moves."""


def bench_views(options: Options) -> Report:
    """Each drive with `--record` and a map file, then the map's page in headless Chromium, rendered in software.

    Raises:
        MissingPackageError: the extra `view` or `test` is not installed. Dpm2Error: there is no Chromium.
    """
    results: dict[str, Any] = {}
    with drives(options) as sources, processors(options.threads):
        for name, source in sources.items():
            with tempfile.TemporaryDirectory(prefix="dpm2_views_") as folder:
                work = Path(folder)
                row = _measure_run(source, options, work)
                page = work / "map.html"
                with MapStore.open(work / "drive.dpm2map") as store:
                    data = load_map(store, descriptors=False)
                    write_map_page(page, data, _VOXEL)
                megabytes = round(page.stat().st_size / 1e6, 2)
                row["page"] = {"keyframes": len(data.poses), "megabytes": megabytes, **_measure_page(page)}
                results[name] = row
    return Report({"drives": results}, _table(results))


def _measure_run(source: Source, options: Options, work: Path) -> dict[str, Any]:
    """Seconds of a run, and the part of them that fed the view; writes `drive.dpm2map`."""
    shown = 0.0
    with (
        OfflineRun(source, configuration_of(options), map_file=work / "drive.dpm2map") as drive,
        LiveView(source.name, viewer=False, record=work / "run.rrd") as live,
        progress_bar() as progress,
    ):
        task = progress.add_task(source.name, total=len(drive))

        def watch(frame: Frame, result: SlamResult, mapper: Mapper) -> None:
            nonlocal shown
            begun = perf_counter()
            live.add(frame, result, mapper)
            shown += perf_counter() - begun
            progress.advance(task)

        begun = perf_counter()
        drive.run(watch=watch)
        seconds = perf_counter() - begun
    return {
        "frames": len(source),
        "seconds_without_view": round(seconds - shown, 3),
        "seconds_of_view": round(shown, 3),
        "view_cost": round(shown / (seconds - shown), 4),
        "recording_megabytes": round((work / "run.rrd").stat().st_size / 1e6, 1),
    }


def _measure_page(path: Path) -> dict[str, float]:
    """Seconds until points and until all of them are drawn, and frames per second while the map is rotated."""
    program = chromium()
    if program is None:
        raise Dpm2Error("no Chromium (Debian: apt install chromium)")
    with needs("test", "the browser"):
        from playwright.sync_api import sync_playwright
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(SOFTWARE))
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.set_default_timeout(120_000)
            page.goto("about:blank")
            begun = perf_counter()
            page.goto(path.as_uri(), wait_until="commit")
            seconds = []
            for drawn in ("dpm2.drawn > 0", "dpm2.drawn === dpm2.points"):
                while not page.evaluate(f"Boolean(window.dpm2 && {drawn})"):
                    page.wait_for_timeout(10)
                seconds.append(round(perf_counter() - begun, 2))
            rate = float(page.evaluate(_ROTATE_SCRIPT))
        finally:
            browser.close()
    return {"seconds_to_first": seconds[0], "seconds_to_all": seconds[1], "frames_per_second": round(rate, 1)}


def _table(results: dict[str, Any]) -> FigureTable:
    columns = {
        "frames": "{frames}", "view's cost": "{view_cost:.1%}", "keyframes": "{page[keyframes]}",
        "page MB": "{page[megabytes]:.1f}", "first picture s": "{page[seconds_to_first]:.2f}",
        "all points s": "{page[seconds_to_all]:.2f}", "turned, frames/s": "{page[frames_per_second]:.0f}",
    }  # fmt: skip
    return record_table("Live view and map page", ["drive"], columns, results)
