# SPDX-License-Identifier: Apache-2.0
"""Sensors and kinds of places of the synthetic city."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dpm2_core.config import Settings

PresetName = Literal["city", "suburb", "rural", "highway", "tunnel"]
PRESET_NAMES: tuple[PresetName, ...] = ("city", "suburb", "rural", "highway", "tunnel")


class LidarConfig(Settings):
    """A spinning LiDAR on a car."""

    beams: Literal[16, 32, 64, 128] = 64
    """Number of beams; 64 has the angles of the HDL-64E, 16 those of the VLP-16, 32 of the HDL-32E, 128 of the VLS-128."""
    columns: int = Field(default=2170, ge=16, le=8192)
    """Firings per turn; 2170 gives about 120 thousand returns with 64 beams, as KITTI has."""
    height: float = Field(default=1.73, gt=0, le=10)
    """Of the sensor above the ground, m."""
    range: float = Field(default=80.0, gt=1, le=300)
    """Farthest return, m."""
    min_range: float = Field(default=1.2, ge=0)
    """Nearest return, m."""
    noise: float = Field(default=0.02, ge=0)
    """Standard deviation of a range, m; rough surfaces add theirs."""
    dropout: float = Field(default=0.01, ge=0, lt=1)
    """Share of returns lost at random; glass, dark paint, leaves and grazing far surfaces lose more."""
    period: float = Field(default=0.1, gt=0)
    """Of one turn, s."""
    car_body: bool = True
    """The car's own roof hides the lowest beams ahead and behind, as on KITTI's car."""


class CameraConfig(Settings):
    """A forward-looking rectified colour camera, 0.27 m ahead of and 0.08 m below the LiDAR."""

    width: int = Field(default=1241, ge=16, le=8192)
    """Pixels."""
    height: int = Field(default=376, ge=16, le=8192)
    """Pixels."""
    focal: float = Field(default=720.0, gt=0)
    """Focal length, pixels."""
    shadows: bool = True
    """Cast shadows of the sun."""
    noise: float = Field(default=2.0, ge=0)
    """Standard deviation of a pixel value, of 255."""


class Preset(Settings):
    """A kind of place. Densities are means: each world varies them by its seed."""

    half_width: float
    """Centre line to kerb, m."""
    lane: float
    """Centre line to the middle of the driven lane, m."""
    sidewalk: float = 0.0
    """Width, m; 0 for a grass verge."""
    setback: float = 6.0
    """Kerb to facade, m."""
    buildings: float = 0.0
    """Share of the frontage that is built."""
    floors: tuple[int, int] = (1, 3)
    """Fewest and most."""
    side_streets: float = 0.0
    """Crossings per 100 m."""
    trees: float = 0.0
    """Per 100 m and side, near the road; as many again behind."""
    forest: float = 0.0
    """Per 100 m and side, of belts of trees and bushes."""
    bushes: float = 0.0
    """Per 100 m and side."""
    boundaries: float = 0.0
    """Share of the frontage with hedge, wall or fence."""
    parked: float = 0.0
    """Share of the kerb with parked cars."""
    poles: float = 0.0
    """Lamps, signs, bollards and boxes per 100 m and side."""
    tufts: float = 0.0
    """Of grass, per m and side."""
    people: float = 0.0
    """Walking or cycling, per 100 m."""
    traffic: float = 0.0
    """Moving cars per 100 m."""
    speed: float = 10.0
    """Of the drive on a straight, m/s."""
    hills: float = 1.0
    """Amplitude of the terrain, m."""
    roughness: float = 0.05
    """Amplitude of unevenness beside the road, m."""
    degenerate: bool = False
    """Constant section: nothing in the geometry tells the motion along the road."""


PRESETS: dict[PresetName, Preset] = {
    "city": Preset(
        half_width=5.4, lane=1.75, sidewalk=2.4, setback=4.0, buildings=0.8, floors=(2, 6), side_streets=1.2, trees=4.0,
        bushes=3.0, boundaries=0.3, parked=0.45, poles=6.0, tufts=0.1, people=2.5, traffic=1.5, speed=11.0, hills=0.6,
    ),
    "suburb": Preset(
        half_width=4.8, lane=1.6, sidewalk=1.8, setback=8.0, buildings=0.55, floors=(1, 3), side_streets=1.0, trees=5.0,
        bushes=9.0, boundaries=0.65, parked=0.3, poles=4.0, tufts=0.4, people=1.0, traffic=0.8, speed=10.0, hills=1.5,
    ),
    "rural": Preset(
        half_width=3.6, lane=1.7, setback=16.0, buildings=0.08, floors=(1, 2), side_streets=0.3, trees=3.5, forest=1.5,
        bushes=8.0, boundaries=0.15, poles=2.5, tufts=1.2, people=0.1, traffic=0.8, speed=16.0, hills=4.0, roughness=0.18,
    ),
    "highway": Preset(half_width=11.0, lane=6.5, speed=25.0, hills=0.0, roughness=0.0, traffic=1.5, degenerate=True),
    "tunnel": Preset(half_width=4.2, lane=1.8, speed=14.0, hills=0.0, roughness=0.0, traffic=0.3, degenerate=True),
}  # fmt: skip
