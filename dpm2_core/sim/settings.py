# SPDX-License-Identifier: Apache-2.0
"""Sensors and kinds of places of the synthetic city."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError

PresetName = Literal["city", "suburb", "rural", "highway", "tunnel", "indoor", "car_park"]
PRESET_NAMES: tuple[PresetName, ...] = get_args(PresetName)


class Imperfections(Settings):
    """What a real LiDAR adds to an exact one. By default nothing: the clean sensor."""

    serial: int = Field(default=0, ge=0)
    """Which sensor of its kind: the seed of what sets it apart."""
    emitters: tuple[float, float] = (0.0, 0.0)
    """Height of the origins of the upper and of the lower half of the beams over that of the sensor, m."""
    uneven: float = Field(default=0.0, ge=0, le=1)
    """Deviation of the beams' elevations from even spacing, deg, as the driver knows it."""
    angle_bias: float = Field(default=0.0, ge=0, le=1)
    """Deviation of the beams' elevations and azimuths from what the driver believes, deg."""
    range_bias: float = Field(default=0.0, ge=0, le=1)
    """Deviation of the beams' errors of range, m."""
    growth: float = Field(default=0.0, ge=0, le=0.1)
    """Noise of a range, m, for each m of it."""
    footprint: float = Field(default=0.0, ge=0, le=0.1)
    """Divergence of a beam, rad: noise at grazing incidence, and ranges between two surfaces at edges."""
    panes: bool = False
    """Glass and paint swallow the pulses of a whole pane or panel, or of none of it, rather than single ones."""
    weak: float = Field(default=0.0, ge=0, le=20)
    """The receiver needs 1 + this times the light: dark, far and grazing surfaces are lost."""
    glare: float = Field(default=0.0, ge=0, le=1)
    """Probability that a pulse just beside a retro-reflector returns at its distance."""
    drops: float = Field(default=0.0, ge=0, le=1)
    """Rain, snow or dust: returns from drops for each m of a pulse's way."""
    dirt: float = Field(default=0.0, ge=0, lt=1)
    """Fraction of the window with dirt on it."""
    skew: float = Field(default=0.0, ge=0, le=2)
    """Deviation, as a fraction, of the motion during a turn that the points are corrected by."""
    sway: float = Field(default=1.0, ge=0, le=20)
    """Times the usual pitch and roll of the body."""


class LidarConfig(Settings):
    """A LiDAR on a car."""

    pattern: Literal["spinning", "rosette"] = "spinning"
    """A turning row of beams, or a row of lasers behind two prisms that draws a rosette of 70 deg ahead and never
    repeats it, as Livox sensors do."""
    beams: Literal[16, 32, 64, 128] = 64
    """Number of beams, spinning with the angles of the VLP-16, HDL-32E, HDL-64E or, for 128, +15 to -25 deg."""
    columns: int = Field(default=2170, ge=16, le=8192)
    """Firings per turn of each beam; 2170 gives about 120 thousand returns with 64 beams, as KITTI has."""
    height: float = Field(default=1.73, gt=0, le=10)
    """Of the sensor above the ground, m."""
    range: float = Field(default=80.0, gt=1, le=300)
    """Farthest return, m."""
    min_range: float = Field(default=1.2, ge=0)
    """Nearest return, m."""
    noise: float = Field(default=0.02, ge=0)
    """Standard deviation of a range, m; rough surfaces add theirs."""
    dropout: float = Field(default=0.01, ge=0, lt=1)
    """Fraction of returns lost at random; glass, dark paint, leaves and grazing far surfaces lose more."""
    car_body: bool = True
    """The car's own roof hides the lowest beams ahead and behind, as on KITTI's car; of a spinning sensor."""
    roll: float = Field(default=0.0, ge=-180, le=180)
    """Of the mount, deg, to the right."""
    pitch: float = Field(default=0.0, ge=-90, le=90)
    """Of the mount, deg, downwards."""
    real: Imperfections = Imperfections()


HDL64E = LidarConfig(
    noise=0.007, dropout=0.001,
    real=Imperfections(
        emitters=(0.205, 0.13), uneven=0.036, angle_bias=0.02, range_bias=0.02, growth=0.0005, footprint=0.0015,
        panes=True, glare=0.3, skew=0.05, sway=0.4,
    ),
)  # fmt: skip
"""As KITTI's, by `dpm2 bench sensor`. Its lasers sit up to 0.2 m above the origin of the points, which the driver does
not hide: how far down a beam looks depends on what it meets."""


class ImuConfig(Settings):
    """An IMU in the LiDAR's housing, by default as the MEMS ones there are. Its errors are standard deviations."""

    gyro_noise: float = Field(default=0.002, ge=0)
    """Of a sample, rad/s."""
    gyro_bias: float = Field(default=0.01, ge=0)
    """Of the sensor, rad/s; it drifts by a hundredth of that in a second."""
    acceleration_noise: float = Field(default=0.03, ge=0)
    """Of a sample, m/s2."""
    acceleration_bias: float = Field(default=0.05, ge=0)
    """Of the sensor, m/s2."""
    scale: float = Field(default=0.005, ge=0)
    """Of each axis, as a fraction."""
    misaligned: float = Field(default=0.3, ge=0)
    """Of the mount from what the calibration says, deg about each axis."""


class GnssConfig(Settings):
    """A receiver of satellites, by default a plain one. Errors are standard deviations, twice as large in height."""

    rate: float = Field(default=5.0, gt=0, le=10)
    """Fixes per second."""
    noise: float = Field(default=0.3, ge=0)
    """Of each fix, m."""
    wander: float = Field(default=1.5, ge=0)
    """Of an error that stays for a while, m."""
    wander_time: float = Field(default=60.0, gt=0)
    """s in which it becomes another one."""
    antenna: tuple[float, float, float] = (-0.4, 0.0, 0.2)
    """In the LiDAR's frame, m."""


class CameraConfig(Settings):
    """A forward-looking rectified color camera, 0.27 m ahead of and 0.08 m below the LiDAR."""

    width: int = Field(default=1241, ge=16, le=8192)
    """Pixels."""
    height: int = Field(default=376, ge=16, le=8192)
    """Pixels."""
    focal: float = Field(default=720.0, gt=0)
    """Focal length, pixels."""
    noise: float = Field(default=2.0, ge=0)
    """Standard deviation of a pixel value, of 255."""
    wet: float = Field(default=0.0, ge=0, le=0.8)
    """Fraction of the lens behind drops of water."""
    lens: int = Field(default=0, ge=0)
    """Seed of the drops."""


class DriveConfig(Settings):
    """A drive through a world: with the version of this program, all that its files depend on."""

    frames: int | None = None
    """At 10 Hz; None for 150, or all of a file of poses."""
    seed: int = 0
    """Of the world and the noise."""
    road: str = "loop"
    """straight, loop, figure8, random, or a file of KITTI poses. The lap of a closed road is chosen so that the drive
    ends where it began."""
    preset: PresetName = "city"
    """Kind of place."""
    images: bool = True
    """Render the images of the camera."""
    traffic: float = 1.0
    """Times that of the preset; see `with_traffic`."""
    lidar: LidarConfig = LidarConfig()
    camera: CameraConfig = CameraConfig()
    imu: ImuConfig | None = None
    """None: there is none."""
    gnss: GnssConfig | None = None
    """Likewise."""


class Preset(Settings):
    """A kind of place. Densities are means: `varied` draws each world's own."""

    half_width: float
    """Center line to kerb, m."""
    lane: float = 1.8
    """Center line to the middle of the driven lane, m."""
    sidewalk: float = 0.0
    """Width, m; 0 for a grass verge."""
    setback: float = 6.0
    """Kerb to facade, m."""
    buildings: float = 0.0
    """Fraction of the frontage that is built."""
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
    """Fraction of the frontage with hedge, wall or fence."""
    parked: float = 0.0
    """Fraction of the kerb with parked cars."""
    poles: float = 0.0
    """Lamps, signs, bollards and boxes per 100 m and side."""
    clutter: float = 0.0
    """Sheds, boxes, benches and cars in yards, per 100 m and side."""
    tufts: float = 0.0
    """Of grass, per m and side."""
    people: float = 0.0
    """Walking or cycling, per 100 m."""
    traffic: float = 0.0
    """Moving cars per 100 m."""
    columns: bool = False
    """Two lanes each way, and bumper to bumper on them as `traffic` says; else single cars on one or two."""
    speed: float = 10.0
    """Of the drive on a straight, m/s."""
    hills: float = 1.0
    """Amplitude of the terrain, m."""
    roughness: float = 0.05
    """Amplitude of unevenness beside the road, m."""
    degenerate: bool = False
    """Constant section: nothing in the geometry constrains the motion along the road."""
    indoor: Literal["", "rooms", "deck"] = ""
    """Inside a building: the way leads through rooms or along a deck, and nothing is beside it but them."""

    @property
    def wide(self) -> bool:
        """Whether it has two lanes each way."""
        return self.half_width > 10


PRESETS: dict[PresetName, Preset] = {
    "city": Preset(
        half_width=5.0, sidewalk=2.2, setback=3.6, buildings=0.8, floors=(2, 6), side_streets=1.1, trees=6.0,
        forest=0.15, bushes=12.0, boundaries=0.5, parked=0.7, poles=7.0, clutter=5.0, tufts=0.15, people=2.5,
        traffic=1.5, speed=11.0, hills=0.8,
    ),
    "suburb": Preset(
        half_width=4.4, sidewalk=1.7, setback=7.0, buildings=0.6, floors=(1, 3), side_streets=0.9, trees=7.0,
        forest=0.4, bushes=18.0, boundaries=0.8, parked=0.45, poles=5.0, clutter=7.0, tufts=0.5, people=1.0,
        traffic=0.8, speed=10.0, hills=1.5, roughness=0.07,
    ),
    "rural": Preset(
        half_width=3.8, setback=16.0, buildings=0.1, floors=(1, 2), side_streets=0.3, trees=4.0, forest=2.4,
        bushes=14.0, boundaries=0.25, poles=3.0, clutter=1.0, tufts=1.2, people=0.1, traffic=0.8, speed=16.0,
        hills=4.0, roughness=0.15,
    ),
    "highway": Preset(half_width=11.0, lane=6.5, speed=25.0, hills=0.0, roughness=0.0, traffic=1.5, degenerate=True),
    "tunnel": Preset(half_width=4.2, speed=14.0, hills=0.0, roughness=0.0, traffic=0.3, degenerate=True),
    "indoor": Preset(half_width=1.0, lane=0.0, speed=1.2, hills=0.0, roughness=0.0, indoor="rooms"),
    "car_park": Preset(half_width=3.0, lane=0.0, speed=4.0, hills=0.0, roughness=0.0, indoor="deck"),
}  # fmt: skip
_DENSITIES = (
    "buildings", "side_streets", "trees", "forest", "bushes", "boundaries", "parked", "poles", "clutter", "tufts",
    "people", "traffic", "hills", "roughness",
)  # fmt: skip


def varied(preset: Preset, rng: np.random.Generator) -> Preset:
    """One world's own values: variety of worlds is what makes a network trained on them work elsewhere."""
    if preset.indoor:
        return preset
    if preset.degenerate:
        return preset.model_copy(update={"traffic": preset.traffic * rng.uniform(0.3, 1.7)})
    own = {name: getattr(preset, name) * rng.uniform(0.3, 1.6) for name in _DENSITIES}
    own |= {name: min(own[name], 0.95) for name in ("buildings", "boundaries", "parked")}
    half_width = preset.half_width * rng.uniform(0.65, 1.25)
    sidewalk = preset.sidewalk * rng.uniform(0.6, 1.5)
    own |= {"half_width": half_width, "sidewalk": sidewalk}
    # past the parked cars, in a narrow street in its middle
    own["lane"] = float(np.clip(half_width - (3.0 if preset.parked else 1.7), 0.3, 1.8))
    own["setback"] = max(preset.setback * rng.uniform(0.5, 1.5), sidewalk + 0.5)
    return preset.model_copy(update=own)


def with_traffic(own: Preset, nominal: Preset, factor: float) -> Preset:
    """A world's own preset with `factor` times the traffic: 0 for none, 20 fills every lane.

    Above 1 the cars drive in columns, ahead, behind, alongside and oncoming, on a road that is wide enough for them,
    and as many of them in each world: then the world is not the one of factor 1.

    Raises:
        UsageError: a factor that cannot be.
    """
    if not 0 <= factor <= 1000:
        raise UsageError(f"--traffic {factor:g}: want 0 to 1000 times the preset's")
    if own.indoor and factor > 1:
        raise UsageError(f"--traffic {factor:g}: there is none indoors; want 0 to 1")
    if factor <= 1:
        return own.model_copy(update={"traffic": own.traffic * factor, "people": own.people * factor})
    wide = {} if own.wide else {"lane": 1.8, "half_width": 9.4 if own.parked else 7.2}
    return own.model_copy(update={"traffic": nominal.traffic * factor, "columns": True, **wide})
