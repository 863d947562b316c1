# SPDX-License-Identifier: Apache-2.0
"""Sensors and environments of the synthetic city."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.errors import UsageError

PresetName = Literal["city", "suburb", "rural", "highway", "tunnel", "indoor", "car_park"]
PRESET_NAMES: tuple[PresetName, ...] = get_args(PresetName)


class Imperfections(Settings):
    """Errors of a real LiDAR. All are 0 by default: an ideal sensor."""

    serial: int = Field(default=0, ge=0)
    """Number of the individual sensor: seed of its own errors."""
    emitters: tuple[float, float] = (0.0, 0.0)
    """Height of the origins of the upper and of the lower half of the beams above the sensor's origin, m."""
    uneven: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation of the beams' elevations from even spacing, deg; known to the driver."""
    angle_bias: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation of the beams' elevations and azimuths from those that the driver assumes, deg."""
    range_bias: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation of the range errors of the beams, m."""
    growth: float = Field(default=0.0, ge=0, le=0.1)
    """Range noise, m, per m of range."""
    footprint: float = Field(default=0.0, ge=0, le=0.1)
    """Divergence of a beam, rad: causes noise at grazing incidence, and ranges between two surfaces at edges."""
    panes: bool = False
    """Glass and paint absorb the pulses on whole panes or panels, instead of single pulses."""
    weak: float = Field(default=0.0, ge=0, le=20)
    """The receiver needs 1 + this times the light: returns from dark, far and grazing surfaces are lost."""
    glare: float = Field(default=0.0, ge=0, le=1)
    """Probability that a pulse next to a retro-reflector returns at the distance of the retro-reflector."""
    drops: float = Field(default=0.0, ge=0, le=1)
    """Rain, snow or dust: returns from drops per m of a pulse's path."""
    dirt: float = Field(default=0.0, ge=0, lt=1)
    """Fraction of the window that is dirty."""
    skew: float = Field(default=0.0, ge=0, le=2)
    """Standard deviation, as a fraction, of the error of the motion with which a driver de-skews the points."""
    sway: float = Field(default=1.0, ge=0, le=20)
    """Factor on the usual pitch and roll of the vehicle."""


class LidarConfig(Settings):
    """A LiDAR on a car."""

    pattern: Literal["spinning", "rosette"] = "spinning"
    """spinning: a rotating row of beams. rosette: a row of lasers behind two prisms, with a non-repeating pattern of
    70 deg ahead, as in Livox sensors."""
    beams: Literal[16, 32, 64, 128] = 64
    """Number of beams; spinning with the angles of the VLP-16, HDL-32E, HDL-64E or, for 128, +15 to -25 deg."""
    columns: int = Field(default=2170, ge=16, le=8192)
    """Firings per revolution of each beam; 2170 gives about 120 thousand returns with 64 beams, as in KITTI."""
    height: float = Field(default=1.73, gt=0, le=10)
    """Height of the sensor above the ground, m."""
    range: float = Field(default=80.0, gt=1, le=300)
    """Largest range, m."""
    min_range: float = Field(default=1.2, ge=0)
    """Smallest range, m."""
    noise: float = Field(default=0.02, ge=0)
    """Standard deviation of a range, m; rough surfaces add to it."""
    dropout: float = Field(default=0.01, ge=0, lt=1)
    """Fraction of returns lost at random; more are lost on glass, dark paint, leaves and grazing far surfaces."""
    car_body: bool = True
    """The car's roof hides the lowest beams ahead and behind, as on KITTI's car; only for a spinning sensor."""
    roll: float = Field(default=0.0, ge=-180, le=180)
    """Roll of the mount, deg, to the right."""
    pitch: float = Field(default=0.0, ge=-90, le=90)
    """Pitch of the mount, deg, downwards."""
    real: Imperfections = Imperfections()


HDL64E = LidarConfig(
    noise=0.007, dropout=0.001,
    real=Imperfections(
        emitters=(0.205, 0.13), uneven=0.036, angle_bias=0.02, range_bias=0.02, growth=0.0005, footprint=0.0015,
        panes=True, glare=0.3, skew=0.05, sway=0.4,
    ),
)  # fmt: skip
"""KITTI's sensor, matched with `dpm2 bench sensor`. Its lasers are up to 0.2 m above the origin of the points, and the
driver does not correct that: the apparent elevation of a beam depends on the range."""


class ImuConfig(Settings):
    """An IMU in the LiDAR's housing, by default a typical MEMS one. Its errors are standard deviations."""

    gyro_noise: float = Field(default=0.002, ge=0)
    """Noise of a sample, rad/s."""
    gyro_bias: float = Field(default=0.01, ge=0)
    """Bias of the sensor, rad/s; it drifts by a hundredth of that per second."""
    acceleration_noise: float = Field(default=0.03, ge=0)
    """Noise of a sample, m/s2."""
    acceleration_bias: float = Field(default=0.05, ge=0)
    """Bias of the sensor, m/s2."""
    scale: float = Field(default=0.005, ge=0)
    """Scale error of each axis, as a fraction."""
    misaligned: float = Field(default=0.3, ge=0)
    """Error of the calibrated orientation of the mount, deg about each axis."""


class GnssConfig(Settings):
    """A GNSS receiver, by default a plain one. Errors are standard deviations, twice as large in height."""

    rate: float = Field(default=5.0, gt=0, le=10)
    """Fixes per second."""
    noise: float = Field(default=0.3, ge=0)
    """White noise of each fix, m."""
    wander: float = Field(default=1.5, ge=0)
    """Slowly changing error, m."""
    wander_time: float = Field(default=60.0, gt=0)
    """Correlation time of the slowly changing error, s."""
    antenna: tuple[float, float, float] = (-0.4, 0.0, 0.2)
    """Position of the antenna in the LiDAR frame, m."""


class CameraConfig(Settings):
    """A forward-looking rectified color camera, 0.27 m ahead of and 0.08 m below the LiDAR."""

    width: int = Field(default=1241, ge=16, le=8192)
    """Width, pixels."""
    height: int = Field(default=376, ge=16, le=8192)
    """Height, pixels."""
    focal: float = Field(default=720.0, gt=0)
    """Focal length, pixels."""
    noise: float = Field(default=2.0, ge=0)
    """Standard deviation of a pixel value, out of 255."""
    wet: float = Field(default=0.0, ge=0, le=0.8)
    """Fraction of the lens covered by water drops."""
    lens: int = Field(default=0, ge=0)
    """Seed of the drops."""


class DriveConfig(Settings):
    """A drive through a world. Together with the program's version, it determines all files of the drive."""

    frames: int | None = None
    """Number, at 10 Hz; None for 150, or for all in a file of poses."""
    seed: int = 0
    """Seed of the world and the noise."""
    road: str = "loop"
    """straight, loop, figure8, random, or a file of KITTI poses. The lap length of a closed road is chosen so that the
    drive ends where it began."""
    preset: PresetName = "city"
    """Type of environment."""
    images: bool = True
    """Render the images of the camera."""
    traffic: float = 1.0
    """Factor on the preset's traffic; see `with_traffic`."""
    lidar: LidarConfig = LidarConfig()
    camera: CameraConfig = CameraConfig()
    imu: ImuConfig | None = None
    """None for no IMU."""
    gnss: GnssConfig | None = None
    """None for no receiver."""


class Preset(Settings):
    """A type of environment. Densities are means: `varied` draws the values of each world."""

    half_width: float
    """Center line to curb, m."""
    lane: float = 1.8
    """Center line to the middle of the driven lane, m."""
    sidewalk: float = 0.0
    """Width, m; 0 for a grass verge."""
    setback: float = 6.0
    """Curb to facade, m."""
    buildings: float = 0.0
    """Fraction of the frontage that is built."""
    floors: tuple[int, int] = (1, 3)
    """Smallest and largest number."""
    side_streets: float = 0.0
    """Crossings per 100 m."""
    trees: float = 0.0
    """Per 100 m and side, near the road; the same number again behind."""
    forest: float = 0.0
    """Trees and bushes in belts, per 100 m and side."""
    bushes: float = 0.0
    """Per 100 m and side."""
    boundaries: float = 0.0
    """Fraction of the frontage with hedge, wall or fence."""
    parked: float = 0.0
    """Fraction of the curb with parked cars."""
    poles: float = 0.0
    """Lamps, signs, bollards and boxes per 100 m and side."""
    clutter: float = 0.0
    """Sheds, boxes, benches and cars in yards, per 100 m and side."""
    tufts: float = 0.0
    """Tufts of grass, per m and side."""
    people: float = 0.0
    """Pedestrians and cyclists, per 100 m."""
    traffic: float = 0.0
    """Moving cars per 100 m."""
    columns: bool = False
    """Two lanes each way with columns of cars, whose density is `traffic`; else single cars on one or two lanes."""
    speed: float = 10.0
    """Speed of the drive on a straight, m/s."""
    hills: float = 1.0
    """Amplitude of the terrain, m."""
    roughness: float = 0.05
    """Amplitude of unevenness next to the road, m."""
    degenerate: bool = False
    """Constant cross-section: nothing in the geometry constrains the motion along the road."""
    indoor: Literal["", "rooms", "deck"] = ""
    """Inside a building: the path leads through rooms or along a deck, and there is nothing outside them."""

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
    """The values of one world. Networks generalize because the worlds that they are trained on differ."""
    if preset.indoor:
        return preset
    if preset.degenerate:
        return preset.model_copy(update={"traffic": preset.traffic * rng.uniform(0.3, 1.7)})
    values = {name: getattr(preset, name) * rng.uniform(0.3, 1.6) for name in _DENSITIES}
    values |= {name: min(values[name], 0.95) for name in ("buildings", "boundaries", "parked")}
    half_width = preset.half_width * rng.uniform(0.65, 1.25)
    sidewalk = preset.sidewalk * rng.uniform(0.6, 1.5)
    values |= {"half_width": half_width, "sidewalk": sidewalk}
    # past the parked cars; in the middle of a narrow street
    values["lane"] = float(np.clip(half_width - (3.0 if preset.parked else 1.7), 0.3, 1.8))
    values["setback"] = max(preset.setback * rng.uniform(0.5, 1.5), sidewalk + 0.5)
    return preset.model_copy(update=values)


def with_traffic(preset: Preset, nominal: Preset, factor: float) -> Preset:
    """A world's own preset with `factor` times the traffic: 0 for none, 20 fills every lane.

    Above 1 the cars drive in columns, ahead, behind, alongside and oncoming, on a road that is wide enough for them.
    Their number is then the same in each world; the world differs from the one of factor 1.

    Raises:
        UsageError: the factor is out of range.
    """
    if not 0 <= factor <= 1000:
        raise UsageError(f"--traffic {factor:g}: want 0 to 1000 times the preset's")
    if preset.indoor and factor > 1:
        raise UsageError(f"--traffic {factor:g}: there is no traffic indoors; want 0 to 1")
    if factor <= 1:
        return preset.model_copy(update={"traffic": preset.traffic * factor, "people": preset.people * factor})
    wide = {} if preset.wide else {"lane": 1.8, "half_width": 9.4 if preset.parked else 7.2}
    return preset.model_copy(update={"traffic": nominal.traffic * factor, "columns": True, **wide})
