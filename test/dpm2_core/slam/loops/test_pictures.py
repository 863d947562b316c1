# SPDX-License-Identifier: Apache-2.0
"""Where the points fit everywhere, an image determines the place. If the image fits nowhere or twice, there is no
result."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dpm2_core.data.thumbnail import PLACE_WIDTH, thumbnail
from dpm2_core.estimates import Keyframe
from dpm2_core.frame import Array
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ByScale
from dpm2_core.network.pretrained import load_network
from dpm2_core.slam.loops.localizer import Localizer
from dpm2_core.slam.loops.pictures import KnownMap
from dpm2_core.slam.loops.place_recognition import PlaceRecognition
from dpm2_core.slam.loops.relocalization import RelocalizationSettings, Relocalizer
from dpm2_core.slam.loops.verification import VerificationSettings, Verifier
from dpm2_core.slam.preprocess import PreprocessSettings
from dpm2_core.slam.registration.icp import GeometricSettings
from dpm2_core.slam.registration.texture import VisualSettings

from ....helpers.corridor import Paint, frame, random_paint, stripes

pytestmark = pytest.mark.weights

AT = np.arange(0.0, 41.0, 5.0)
PAINT = random_paint()


def keyframe(x: float, paint: Paint, index: int, pictured: bool = True) -> Keyframe:
    whole = with_picture(x, paint, index)
    return whole if pictured else replace(whole, thumbnail=None)


@cache
def with_picture(x: float, paint: Paint, index: int) -> Keyframe:
    """Cached: do not write to it. The maps of the tests share these keyframes."""
    seen = frame(x, paint, index, gain=0.8)
    picture = thumbnail(seen.images[0], PLACE_WIDTH)
    whole = Keyframe(index, index * 10**9, index, place(x), seen.points, thumbnail=picture)
    return replace(whole, descriptors=PlaceRecognition(load_network("small", 1)).descriptors(whole))


def place(x: float) -> Array:
    return se3.make(np.eye(3), np.array([x, 0, 0]))


def in_map(keyframes: list[Keyframe]) -> KnownMap:
    """Map with a keyframe at each of `AT`."""
    poses = np.array([place(x) for x in AT])
    return KnownMap(keyframes, lambda n: keyframes[n].cloud, poses, lambda n: keyframes[n].thumbnail)


def searching(known: KnownMap, visual: VisualSettings) -> Relocalizer:
    verifier = Verifier(VerificationSettings(), GeometricSettings(), PreprocessSettings())
    network = load_network("small", 1)
    return Relocalizer(RelocalizationSettings(), visual, ByScale(verifier, verifier), network, known)


def relocalizer(paint: Paint, pictured: bool = True, visual: VisualSettings | None = None) -> Relocalizer:
    keyframes = [keyframe(x, paint, n, pictured) for n, x in enumerate(AT)]
    known = in_map(keyframes)
    return searching(known, visual or VisualSettings())


@pytest.mark.slow
def test_a_place_in_a_corridor_is_found_by_its_picture_alone() -> None:
    """The accuracy is 5 cm, two steps of the fine search at half the resolution. Without the robot's image or those of
    the map, the place is not found."""
    visit = keyframe(18.3, PAINT, 77)
    found = relocalizer(PAINT).find(visit)
    assert found.ok, found.reason
    assert found.T_target_source[0, 3] == pytest.approx(18.3, abs=0.05)
    np.testing.assert_allclose(found.T_target_source[1:3, 3], 0, atol=0.03)
    assert found.worst_sigma < 0.1
    blind = relocalizer(PAINT).find(replace(visit, thumbnail=None))
    assert not blind.ok
    for without in (relocalizer(PAINT, pictured=False), relocalizer(PAINT, visual=VisualSettings(enabled=False))):
        assert not without.find(visit).ok


@pytest.mark.slow
@pytest.mark.parametrize(
    ("paint", "seen", "why"),
    [
        (PAINT, random_paint(5), "no more than with a place that looks alike"),
        (stripes, stripes, "the images of two places are alike"),
    ],
    ids=["elsewhere", "repetitive"],
)
def test_a_picture_that_fits_nowhere_or_everywhere_is_no_place(paint: Paint, seen: Paint, why: str) -> None:
    visit = keyframe(18.3, seen, 77)
    found = relocalizer(paint).find(visit)
    assert not found.ok
    assert re.search(why, found.reason), found.reason


@pytest.mark.slow
def test_localization_goes_on_along_a_corridor() -> None:
    """Relocalized, then confirmed at each keyframe, although the odometry overestimates the distance by 4 %. Without
    images the robot never localizes."""
    for pictured in (True, False):
        localizer = Localizer(relocalizer(PAINT))
        states = []
        for n, x in enumerate((7.0, 12.0, 17.0, 22.0, 27.0)):
            now = replace(keyframe(x, PAINT, 100 + n, pictured), T_odom_kf=place(1.04 * (x - 7.0)))
            located = localizer.add(now)
            states.append(str(located.state))
            if pictured:
                assert located.T_map_kf[0, 3] == pytest.approx(x, abs=0.06)
        assert states == (["relocalised"] + ["tracking"] * 4 if pictured else ["relocalising"] * 5)


@pytest.mark.slow
def test_a_damaged_picture_in_a_map_is_no_picture() -> None:
    """The neighboring keyframe shows the place, too."""
    visit = keyframe(18.3, PAINT, 77)
    keyframes = [keyframe(x, PAINT, n) for n, x in enumerate(AT)]
    jpeg = keyframes[4].thumbnail
    assert jpeg is not None
    keyframes[4] = replace(keyframes[4], thumbnail=jpeg[:1000])
    known = in_map(keyframes)
    found = searching(known, VisualSettings()).find(visit)
    assert found.ok, found.reason
    assert found.T_target_source[0, 3] == pytest.approx(18.3, abs=0.1)
