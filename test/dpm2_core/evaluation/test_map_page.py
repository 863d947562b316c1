# SPDX-License-Identifier: Apache-2.0
"""A map as a page: small enough, correct in a real browser, and harmless for any content of the map."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dpm2_core.evaluation.map_page import by_detail, map_page, write_map_page

from ...helpers.browser import opened, wait
from ...helpers.maps import ring


def content(page: str) -> dict[str, Any]:
    """The data of a page."""
    match = re.search(r'id="data">(.*?)</script>', page, re.S)
    assert match is not None
    return dict(json.loads(match[1]))


def test_positions_come_back(noise: np.random.Generator) -> None:
    data = ring(24)
    found = content(map_page(data, 0.3, "ring"))
    at = np.array([keyframe["at"] for keyframe in found["keyframes"]]) + found["middle"]
    np.testing.assert_allclose(at, data.poses[:, :3, 3], atol=2e-3)
    yaw = np.radians([keyframe["yaw"] for keyframe in found["keyframes"]])
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw)])
    np.testing.assert_allclose(ahead, data.poses[:, :2, 0], atol=1e-3)  # the page's resolution is 0.1 degrees
    points = np.frombuffer(base64.b64decode(found["points"]), "<i2").reshape(-1, 3) * found["scale"] + found["middle"]
    away = np.abs(np.hypot(points[:, 0], points[:, 1]) - np.hypot(*data.poses[0, :2, 3]))
    np.testing.assert_allclose(away, 8.0, atol=0.1)  # from the walls, in clouds packed to half a centimeter
    assert [len(track) for track in found["tracks"]] == [24]
    assert [(loop["ok"], loop["reason"]) for loop in found["loops"]] == [(True, ""), (False, "<b>points</b> disagree")]


def test_every_beginning_shows_the_whole(noise: np.random.Generator) -> None:
    """The first hundredth of the points covers the area at the coarse level's resolution, and no point is lost."""
    cloud = np.column_stack([noise.uniform(-50, 50, (40000, 2)), np.zeros((40000, 2))]).astype(np.float32)
    order = by_detail(cloud, 0.4)
    assert sorted(map(tuple, order)) == sorted(map(tuple, cloud))
    cells = np.unique(np.floor(order[:400, :2] / 12.8), axis=0)
    assert len(cells) >= len(np.unique(np.floor(cloud[:, :2] / 12.8), axis=0))


@pytest.mark.slow
def test_500_keyframes_with_images_are_less_than_20_mb(tmp_path: Path) -> None:
    """Noise is hardest to compress as a JPEG, and there are more points than are shown."""
    write_map_page(tmp_path / "ring.html", ring(500, 2500, (320, 240)), 0.05)
    assert (tmp_path / "ring.html").stat().st_size < 20e6
    found = content((tmp_path / "ring.html").read_text())
    assert all(keyframe["image"] for keyframe in found["keyframes"])


def test_images_that_are_none_are_left_out() -> None:
    data = ring(4, 50)
    bomb = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    at = bomb.index(b"\xff\xc0")
    bomb[at + 5 : at + 9] = b"\xff\xff\xff\xff"  # claims 65535 x 65535
    pictures = [b"<svg onload=alert(1)>", b"\xff\xd8 cut off", bytes(bomb), None]
    found = content(map_page(replace(data, thumbnail=lambda node: pictures[node]), 0.3, "t"))
    assert [keyframe["image"] for keyframe in found["keyframes"]] == [None] * 4


@pytest.mark.slow
def test_in_a_browser(tmp_path: Path) -> None:
    """A click shows keyframe, image and verdicts; two clicks measure; nothing is fetched, and no error is reported."""
    data = ring(24, image=(64, 48))
    write_map_page(tmp_path / "<i>ring.html", data, 0.3)
    with opened(tmp_path / "<i>ring.html") as (page, said):
        wait(page, "window.dpm2 && dpm2.drawn === dpm2.points")
        assert page.title() == "<i>ring"
        assert "24 keyframes, 1 loops accepted of 2 tried" in page.inner_text("#status")
        colors = len(set(page.screenshot(type="jpeg", quality=50)))
        assert colors > 100  # something is drawn

        page.mouse.click(*page.evaluate("dpm2.project(0)")[:2])
        panel = page.inner_text("#panel")
        assert "Keyframe 0" in panel
        assert "0 - 23\taccepted" in panel
        assert "0 - 12\trejected: <b>points</b> disagree" in panel
        assert page.evaluate("document.querySelector('#panel img').naturalWidth") == 64
        page.mouse.click(400, 590)
        assert page.is_hidden("#panel")

        page.check("#rejected")
        a, b = page.evaluate("[dpm2.project(0), dpm2.project(12)]")
        page.mouse.click((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)
        assert "0 - 12" in page.inner_text("#panel")

        page.mouse.move(400, 300)
        page.mouse.down()
        page.mouse.move(500, 420, steps=8)
        page.mouse.up()
        assert page.evaluate("dpm2.project(0)") != pytest.approx(a, abs=1)
        page.click("#home")
        assert page.evaluate("dpm2.project(0)") == pytest.approx(a, abs=1)
        wait(page, "dpm2.drawn === dpm2.points")

        # From above, the outer wall at keyframe 0 and at keyframe 12 are two radii plus twice 8 m apart.
        page.mouse.click(400, 590)
        page.click("#measure")
        radius = float(np.hypot(*data.poses[0, :2, 3]))
        for sign in (1, -1):
            x, y = page.evaluate(f"dpm2.at([{sign * (radius + 8)}, 0, 3])")[:2]
            page.mouse.click(x, y)
        page.wait_for_selector("#distance", state="visible")
        length = float(page.inner_text("#distance").split(" m")[0])
        assert length == pytest.approx(2 * (radius + 8), abs=3.0)  # a click has a tolerance of 8 pixels, of 0.2 m each
        page.click("#measure")
        page.wait_for_selector("#distance", state="hidden")
        assert said == []


@pytest.mark.slow
def test_the_command_writes_it(tmp_path: Path) -> None:
    from dpm2_core.slam.store.map_data import save_as

    from ...helpers.command import dpm2

    save_as(ring(5, 100), tmp_path / "ring.dpm2map")
    done = dpm2("map", "export", tmp_path / "ring.dpm2map", tmp_path / "ring.html", "--voxel", "0.5")
    assert done.returncode == 0, done.stderr
    assert len(content((tmp_path / "ring.html").read_text())["keyframes"]) == 5
