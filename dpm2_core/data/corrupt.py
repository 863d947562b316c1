# SPDX-License-Identifier: Apache-2.0
"""A drive with simulated sensor failures. A seed always gives the same failures, whatever else is corrupted."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from dpm2_core.config import Settings, settings_from, value_of
from dpm2_core.data.source import Source
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Frame, Image, Points
from dpm2_core.geometry import se3

Ratio = Annotated[float, Field(ge=0, le=1)]


class CorruptionSettings(Settings):
    """Failures and their rates. With one seed, the frames hit at a fraction of 0.3 are among those hit at 0.5."""

    seed: int = Field(0, ge=0)
    """Seed of all random numbers."""
    camera: Ratio = 0.0
    """Fraction of frames with black images."""
    no_image: Ratio = 0.0
    """Fraction of frames without images."""
    overexposed: Ratio = 0.0
    """Fraction of frames whose images are too bright."""
    underexposed: Ratio = 0.0
    """Fraction of frames whose images are too dark."""
    stops: float = Field(3.0, ge=0, le=16)
    """Over- and underexposure in stops: each stop doubles or halves the light."""
    obstruction: Ratio = 0.0
    """Fraction of frames in which a random box near the LiDAR occludes everything behind it."""
    beams: Ratio = 0.0
    """Fraction of the LiDAR's beams that are always dead; a beam is a band of 0.4 deg of elevation."""
    dust: Ratio = 0.0
    """Fraction of pulses that return from the air within 6 m, unless an object is closer (fog, dust, smoke, snow)."""
    sight: float | None = Field(None, gt=0)
    """Returns from farther away are lost, m."""
    extrinsic_deg: float = Field(0.0, ge=0, le=180)
    """Rotation error of every camera's extrinsics, about a random axis, degrees."""
    extrinsic_m: float = Field(0.0, ge=0)
    """Translation error of every camera's extrinsics, in a random direction, m."""
    time_offset: float = Field(0.0, ge=0)
    """Delay of images: a frame has the images of the last frame at least this old, s; none if there is no such frame.
    """


_BEAM_SPACING = np.radians(0.4)  # the spacing of an HDL-64
_FRAME_FAILURES = ("camera", "no_image", "overexposed", "underexposed", "obstruction")
_RANDOM_STREAMS = (*_FRAME_FAILURES, "beams", "extrinsic", "box", "dust")  # independent streams of random numbers
_DUST_RANGE = (0.4, 6.0)  # m, uniform along a pulse


class Box(NamedTuple):
    """A box: T_lidar_box (4, 4) of its center, and half its edges (3,), m."""

    T_lidar_box: Array
    half: Array


def random_box(rng: np.random.Generator) -> Box:
    """A box with edges of 0.5 to 3 m at any angle, its surface at least 0.5 m and its center at most 8.1 m away."""
    half = rng.uniform(0.25, 1.5, 3)
    distance = np.linalg.norm(half) + rng.uniform(0.5, 5.5)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(-0.3, 0.1)
    direction = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    return Box(se3.make(Rotation.random(random_state=rng).as_matrix(), distance * np.array(direction)), half)


def hidden_by(box: Box, points: Points) -> NDArray[np.bool_]:
    """Which of (N, 3+) points in the LiDAR frame are occluded by the box, seen from the origin.

    That is, the segment from the origin to the point meets the box (A. Kay, J. Kajiya, "Ray tracing complex scenes",
    SIGGRAPH 1986: slabs). False for NaN.
    """
    T_box_lidar = se3.inverse(box.T_lidar_box)
    origin = T_box_lidar[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = points[:, :3].astype(np.float64) @ T_box_lidar[:3, :3].T
        first, second = (-box.half - origin) / direction, (box.half - origin) / direction
        enter = np.minimum(first, second).max(1, initial=0)
        leave = np.maximum(first, second).min(1, initial=1)
        return enter <= leave


def in_dust(points: Points, fraction: float, rng: np.random.Generator) -> Points:
    """(N, 4) in the LiDAR frame; that fraction returns from the air unless an object is closer. Intensities stay.

    The points moved at a fraction of 0.3 are among those moved at 0.5.
    """
    distance = np.linalg.norm(points[:, :3], axis=1)
    draws, dust_distance = rng.random(len(points)), rng.uniform(*_DUST_RANGE, len(points))
    hits_dust = (draws < fraction) & (dust_distance < distance)  # False for NaN
    points = points.copy()
    points[hits_dust, :3] *= (dust_distance[hits_dust] / distance[hits_dust]).astype(np.float32)[:, None]
    return points


def in_fog(points: Points, dust: float, sight: float, rng: np.random.Generator) -> tuple[Points, NDArray[np.bool_]]:
    """(N, 4) in dust, see `in_dust`, and which of them (N,) are within `sight`, m, or are no measurement."""
    points = in_dust(points, dust, rng) if dust else points
    return points, ~(np.linalg.norm(points[:, :3], axis=1) > sight)


class CorruptedSource:
    """A `Source` whose frames are corrupted as they are read; its poses and calibration stay correct."""

    def __init__(self, source: Source, settings: CorruptionSettings) -> None:
        self._source = source
        self._settings = settings
        self.name, self.notes, self.truth = source.name, source.notes, source.truth
        self.numbers, self.in_order = getattr(source, "numbers", None), getattr(source, "in_order", False)
        rotation, translation = self._rng("extrinsic").normal(size=(2, 3))
        rotation *= np.radians(settings.extrinsic_deg) / np.linalg.norm(rotation)
        translation *= settings.extrinsic_m / np.linalg.norm(translation)
        self._T_true_wrong = se3.make(Rotation.from_rotvec(rotation).as_matrix(), translation)
        beams = int(np.pi / _BEAM_SPACING) + 1
        self._dead_beams = self._rng("beams").permutation(beams) < round(settings.beams * beams)
        self._affected = {name: self._choose_frames(name, getattr(settings, name)) for name in _FRAME_FAILURES}

    @property
    def poses(self) -> Array | None:
        return self._source.poses

    @property
    def T_cam_lidar(self) -> Array | None:
        return self._source.T_cam_lidar

    def __len__(self) -> int:
        return len(self._source)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames start..stop-1; they do not depend on whether the frames before are read."""
        delay = self._settings.time_offset
        recent: deque[Frame] = deque()
        first = max(0, start - int(np.ceil(delay * 20)))  # enough frames for the delay, at up to 20 Hz
        for position, frame in enumerate(self._source.frames(first, stop), first):
            recent.append(frame)
            while len(recent) > 1 and frame.stamp - recent[1].stamp >= round(delay * 1e9):
                recent.popleft()
            images = recent[0].images if frame.stamp - recent[0].stamp >= round(delay * 1e9) else ()
            if position >= start:
                yield self._corrupted(replace(frame, images=images), position)

    def _choose_frames(self, name: str, share: float) -> NDArray[np.bool_]:
        """(len,) True for exactly that fraction of the frames."""
        rank = self._rng(name).permutation(len(self._source))
        return rank < round(share * len(rank))

    def _rng(self, stream: str, position: int = 0) -> np.random.Generator:
        return np.random.default_rng([self._settings.seed, _RANDOM_STREAMS.index(stream), position])

    def _corrupted(self, frame: Frame, position: int) -> Frame:
        kept = ~self._dead_beams[self._beam_numbers(frame.points)]
        if self._affected["obstruction"][position]:
            kept &= ~hidden_by(random_box(self._rng("box", position)), frame.points)
        s = self._settings
        points, in_sight = in_fog(frame.points, s.dust, s.sight or np.inf, self._rng("dust", position))
        kept &= in_sight
        offset = None if frame.time_offset is None else frame.time_offset[kept]
        images = () if self._affected["no_image"][position] else tuple(self._image(i, position) for i in frame.images)
        return replace(frame, points=points[kept], time_offset=offset, images=images)

    @staticmethod
    def _beam_numbers(points: Points) -> NDArray[np.intp]:
        """(N,) number of the beam, by elevation; points that are no measurement count as horizontal."""
        x, y, z = points[:, :3].T
        with np.errstate(invalid="ignore", over="ignore"):
            elevation = np.arctan2(z, np.hypot(x, y))
        return ((np.nan_to_num(elevation) + np.pi / 2) / _BEAM_SPACING).astype(np.intp)

    def _image(self, image: Image, position: int) -> Image:
        pixels, stops = image.pixels, self._settings.stops
        if self._affected["overexposed"][position]:
            pixels = exposed(pixels, stops)
        if self._affected["underexposed"][position]:
            pixels = exposed(pixels, -stops)
        if self._affected["camera"][position]:
            pixels = np.zeros_like(pixels)
        camera = replace(image.camera, T_lidar_cam=image.camera.T_lidar_cam @ self._T_true_wrong)
        return replace(image, pixels=pixels, camera=camera)


def exposed(pixels: NDArray[np.uint8], stops: float) -> NDArray[np.uint8]:
    """Pixels with 2**stops times the light, at a gamma of 2.2, clipped."""
    table = np.arange(256) * 2 ** (stops / 2.2)
    return np.clip(np.rint(table), 0, 255).astype(np.uint8)[pixels]


def parse_corruption(text: str) -> CorruptionSettings:
    """`camera=0.3,obstruction=0.5,seed=1` as settings.

    Raises:
        UsageError: not of that form, an unknown name, or a value out of range.
    """
    tree, origin = {}, {}
    for part in text.split(","):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not (key and equals and value):
            raise UsageError(f"--corrupt {text}: want NAME=VALUE,..., such as camera=0.3,seed=1")
        tree[key] = value_of(value)
        origin[key] = f"--corrupt {part.strip()}"
    return settings_from(CorruptionSettings, tree, origin, "--corrupt")
