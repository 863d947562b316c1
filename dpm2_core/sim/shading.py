# SPDX-License-Identifier: Apache-2.0
"""Appearance of surfaces: procedural, non-periodic textures that fade out where a pixel is larger than their detail.

All functions process P visible points at once. Noise comes from one tile of random numbers. It is sampled at
wavelengths that are not multiples of each other, and with a different offset for each object.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dpm2_core.sim.materials import Material
from dpm2_core.sim.mesh import Float, Rows
from dpm2_core.sim.terrain import Terrain

Int = NDArray[np.integer]
_TILE = 512


@dataclass(eq=False)
class VisiblePoints(Rows):
    """P visible points.

    Attributes:
        position: (P, 3) m in the world. normal: (P, 3) unit, towards the eye. view: (P, 3) unit, from the eye.
        uv: (P, 2) m on the surface. texture: (P,) number of the object's pattern. material: (P,).
        color: (P, 3) 0..1, its paint. footprint: (P,) m, extent of a pixel on the surface.
    """

    position: Float
    normal: Float
    view: Float
    uv: Float
    texture: Int
    material: Int
    color: Float
    footprint: Float


class Textures:
    """The textures of a world, from its seed."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 77])
        tile = rng.standard_normal((_TILE, _TILE, 3)).astype(np.float32)
        self.tile = cv2.GaussianBlur(tile, (0, 0), 0.8, borderType=cv2.BORDER_REFLECT)
        self.tile /= self.tile.std()
        self.gray = np.ascontiguousarray(self.tile[..., 0])
        self.marking = rng.uniform(0.55, 0.95)
        self.gaudy = rng.uniform(0.04, 0.16)

    def noise(self, at: Float, wavelength: float, channels: int = 1) -> Float:
        """(P,) or (P, 3) smooth noise of unit variance at (P, 2) m."""
        n = len(at)
        # remap takes images of limited size: here 1024 columns
        xy = np.zeros((max(-(-n // 1024), 1) * 1024, 2), np.float32)
        scaled = at * np.float32(3.0 / wavelength / _TILE)
        xy[:n] = (scaled - np.floor(scaled)) * np.float32(_TILE)
        tile = self.gray if channels == 1 else self.tile
        out = cv2.remap(
            tile, xy[:, 0].reshape(-1, 1024), xy[:, 1].reshape(-1, 1024), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        return out.reshape(-1)[:n] if channels == 1 else out.reshape(-1, channels)[:n]

    def albedo(self, surface: VisiblePoints, terrain: Terrain) -> Float:
        """(P, 3) fraction of the light that each point reflects, by color."""
        uv = surface.uv + np.stack([surface.texture % 251, surface.texture // 251], -1).astype(np.float32) * np.float32(
            1.37
        )
        fade = [np.minimum(np.float32(w) / surface.footprint, 1) for w in (0.05, 0.21, 0.9)]
        strength = _CONTRAST[surface.material]
        shade = np.float32(0.10) * fade[0] * self.noise(uv, 0.053)
        shade += np.float32(0.10) * fade[1] * self.noise(uv + 11, 0.23)
        shade += np.float32(0.12) * fade[2] * self.noise(uv + 37, 1.13)
        shade += np.float32(0.12) * self.noise(uv + 71, 6.7)
        out = surface.color * (1 + strength * shade)[:, None]
        out *= 1 + np.float32(0.05) * strength[:, None] * self.noise(uv + 101, 2.9, 3)
        for material, paint in _PAINTERS.items():
            indices = np.flatnonzero(surface.material == material)
            if len(indices):
                part = surface.part(indices)
                out[indices] = paint(self, part, out[indices], uv[indices], terrain)
        return out.clip(0.01, 1, out=out)


_CONTRAST = np.ones(len(Material), np.float32)
_CONTRAST[[Material.GRASS, Material.LEAF]] = 1.9
_CONTRAST[[Material.GLASS, Material.PAINT, Material.SIGN, Material.LAMP]] = 0.15
_CONTRAST[[Material.PLASTER, Material.BRICK, Material.CONCRETE, Material.CLOTH]] = 0.6


def _hash(*keys: Int) -> NDArray[np.uint32]:
    """(P,) well mixed 32-bit numbers of integer keys (P,)."""
    h = np.full(len(keys[0]), 2166136261, np.uint32)
    for key in keys:
        h = (h ^ key.astype(np.int64).astype(np.uint32)) * np.uint32(2654435761)
        h ^= h >> np.uint32(15)
    h *= np.uint32(2246822519)
    return h ^ (h >> np.uint32(13))


def _unit_interval(h: NDArray[np.uint32], k: int = 0) -> Float:
    """0..1 from bits of a hash; k = 0, 1, 2 give different numbers."""
    return ((h >> np.uint32(10 * k)) & np.uint32(1023)).astype(np.float32) / np.float32(1023)


def _vivid_color(h: NDArray[np.uint32]) -> Float:
    """(P, 3) saturated colors from a hash."""
    hue = _unit_interval(h, 0)[:, None] * 6
    rgb = np.clip(np.abs(np.remainder(hue + np.array([0, 4, 2], np.float32), 6) - 3) - 1, 0, 1)
    return (0.15 + 0.8 * _unit_interval(h, 1)[:, None]) * (0.25 + 0.75 * rgb)


def _lines(at: Float, spacing: float, width: float, footprint: Float) -> Float:
    """(P,) fraction of a pixel covered by lines that are `spacing` m apart and `width` m wide."""
    blur = np.maximum(footprint, 0.25 * width)
    distance = np.abs(np.remainder(at + 0.5 * spacing, spacing) - 0.5 * spacing)
    inside = np.clip((0.5 * width - distance) / blur + 0.5, 0, 1)
    return inside * np.minimum(1, width / blur) if width < 0.2 else inside


def _asphalt(t: Textures, s: VisiblePoints, out: Float, uv: Float, terrain: Terrain) -> Float:
    lateral, along, crossing = terrain.lane_coordinates(s.position[:, :2])
    # repairs: rectangles of another mix; cracks: the zero crossings of a slowly varying noise
    h = _hash(np.floor(along / 3.1), np.floor(lateral / 1.7), s.texture)
    out = out * (0.82 + 0.3 * _unit_interval(h))[:, None] ** (_unit_interval(h, 1) < 0.22)[:, None]
    crack = np.abs(t.noise(uv + 5, 2.3) + 0.4 * t.noise(uv + 9, 0.4)) < 0.05
    out = out * np.where(crack & (t.noise(uv + 19, 15.0) > 0.2), 0.6, 1.0).astype(np.float32)[:, None]
    worn = np.clip(0.85 + 0.3 * t.noise(uv + 23, 0.35), 0, 1) * t.marking
    paint = np.minimum(road_marking(lateral, along, crossing, s.footprint, terrain) * worn, 1)
    return out * (1 - paint[:, None]) + np.float32(0.7) * paint[:, None]


def road_marking(
    lateral: Float, along: Float, crossing: NDArray[np.bool_], footprint: Float, terrain: Terrain
) -> Float:
    """(P,) 0..1 how much paint is at lane coordinates (P,) each: edge lines, a dashed center line, some arrows."""
    preset = terrain.preset
    half = preset.half_width
    blur = np.maximum(footprint, 0.02)

    def line(offset: float, width: float) -> Float:
        return np.clip((width / 2 - np.abs(lateral - offset)) / blur + 0.5, 0, 1).astype(np.float32) * np.minimum(
            1, width / blur
        )

    dash = (np.remainder(along, 9.0) < 4.0).astype(np.float32)
    if preset.wide:
        paint = sum(line(y, 0.15) for y in (-1.0, 1.0, 1.0 - half + 1.6, half - 2.6)) + dash * (
            line(-4.7, 0.14) + line(4.7, 0.14)
        )
    else:
        paint = dash * line(0.0, 0.12)
        if half > 3.4:
            paint = paint + line(half - 0.35, 0.12) + line(0.35 - half, 0.12)
    # an arrow, a bar or a patch of text in some of the 14 m long slots of each lane
    slot = _hash(np.floor(along / 14.3), (lateral > 0).astype(np.int64))
    u, v = np.remainder(along, 14.3), np.abs(lateral) - preset.lane
    symbol = (_unit_interval(slot) < 0.22) & (u < 3.2) & (np.abs(v) < np.where(u > 2.0, 0.5 * (3.2 - u) / 1.2, 0.09))
    bar = (_unit_interval(slot, 1) < 0.05) & (u > 8) & (u < 8.4) & (np.abs(lateral) < half - 0.5)
    return np.where(crossing, 0, np.minimum(paint + symbol + bar, 1)).astype(np.float32)


def _paving(t: Textures, s: VisiblePoints, out: Float, uv: Float, _: Terrain) -> Float:
    grid = np.maximum(_lines(uv[:, 0], 0.5, 0.02, s.footprint), _lines(uv[:, 1], 0.5, 0.02, s.footprint))
    h = _hash(np.floor(uv[:, 0] * 2), np.floor(uv[:, 1] * 2), s.texture)
    return out * ((1 - 0.4 * grid) * (0.9 + 0.2 * _unit_interval(h)))[:, None]


def _grass(t: Textures, s: VisiblePoints, out: Float, uv: Float, _: Terrain) -> Float:
    dry = np.clip(0.5 + 0.45 * t.noise(uv + 3, 9.0) + 0.25 * t.noise(uv + 7, 1.7), 0, 1)[:, None]
    bare = (t.noise(uv + 13, 4.3) > 1.3)[:, None]
    out = out * (1 - dry) + out * np.array([1.5, 1.2, 0.9], np.float32) * dry
    return np.where(bare, out * np.array([1.3, 0.95, 0.9], np.float32), out)


def _plaster(t: Textures, s: VisiblePoints, out: Float, uv: Float, _: Terrain) -> Float:
    streak = np.clip(t.noise(uv * np.array([1, 0.12], np.float32) + 41, 0.7), 0, 2)
    out = out * (1 - 0.12 * streak)[:, None]
    # posters and graffiti within reach of a hand
    h = _hash(np.floor(uv[:, 0] / 1.9), np.floor(uv[:, 1] / 1.3), s.texture)
    low = (np.abs(s.normal[:, 2]) < 0.5) & (s.uv[:, 1] < 2.6)
    is_graffiti = low & (_unit_interval(h, 2) < t.gaudy) & (t.noise(uv + 61, 0.8) > -0.1)
    return np.where(is_graffiti[:, None], _vivid_color(h), out)


def _brick(t: Textures, s: VisiblePoints, out: Float, uv: Float, terrain: Terrain) -> Float:
    course = np.floor(uv[:, 1] / 0.075)
    shift = np.remainder(course, 2) * 0.12
    mortar = np.maximum(_lines(uv[:, 1], 0.075, 0.012, s.footprint), _lines(uv[:, 0] + shift, 0.24, 0.012, s.footprint))
    fine = np.minimum(0.2 / s.footprint, 1)
    h = _hash(course, np.floor((uv[:, 0] + shift) / 0.24))
    out = out * (1 + fine * 0.35 * (_unit_interval(h) - 0.5))[:, None]
    return _plaster(t, s, out * (1 - mortar[:, None]) + 0.33 * mortar[:, None], uv, terrain)


def _roof(t: Textures, s: VisiblePoints, out: Float, uv: Float, _: Terrain) -> Float:
    rows: Float = np.maximum(_lines(uv[:, 1], 0.34, 0.08, s.footprint), _lines(uv[:, 0], 0.25, 0.04, s.footprint))
    return out * (1 - 0.35 * rows)[:, None]


def _wood(t: Textures, s: VisiblePoints, out: Float, uv: Float, _: Terrain) -> Float:
    grain = 0.1 * t.noise(uv * np.array([8, 0.5], np.float32), 0.6)
    return out * (1 + grain - 0.45 * _lines(uv[:, 0], 0.15, 0.015, s.footprint))[:, None]


def _panels(t: Textures, s: VisiblePoints, out: Float, uv: Float, _: Terrain) -> Float:
    """Barriers and tunnel walls: panels of many tints, dirt, graffiti: the only image texture in these environments."""
    # panels of unequal width: slowly varying stretching keeps the seams from repeating
    along, up = s.uv[:, 0], s.uv[:, 1]
    along = along + 0.9 * np.sin(along / 3.7) + 1.3 * np.sin(along / 6.1 + 1) + 2.1 * np.sin(along / 17.3 + 2)
    h = _hash(np.floor(along / 2.5), np.floor(up / 1.35), s.texture)
    hue = (_unit_interval(h, 1) - 0.5)[:, None] * np.array([0.22, 0, -0.22], np.float32)
    out = out * (0.6 + 0.65 * _unit_interval(h))[:, None] * (1 + hue)
    seam: Float = np.maximum(_lines(along, 2.5, 0.03, s.footprint), _lines(up, 1.35, 0.03, s.footprint))
    out = out * (1 - 0.5 * seam)[:, None]
    dirt: Float = np.clip(t.noise(uv * np.array([1, 0.2], np.float32) + 43, 0.9) + 0.8 * t.noise(uv + 47, 5.3), 0, 2.5)
    out = out * (1 - 0.22 * dirt)[:, None]
    patch = _hash(np.floor((along + 0.9 * t.noise(uv, 3.7)) / 3.3), np.floor(up / 1.1))
    letters = np.abs(t.noise(uv + 83, 1.1)) + 0.35 * t.noise(uv + 89, 0.35) < 0.55
    is_graffiti = (_unit_interval(patch, 2) < 0.10 + t.gaudy) & letters
    return np.where(is_graffiti[:, None], _vivid_color(_hash(patch, np.floor(t.noise(uv + 53, 0.9) * 1.5))), out)


def _glass(t: Textures, s: VisiblePoints, out: Float, uv: Float, _: Terrain) -> Float:
    """Frames, and reflections of sky and street, which are stronger at grazing angles."""
    slope = np.abs(np.einsum("ij,ij->i", s.normal, s.view))
    mirror = 0.12 + 0.6 * (1 - slope) ** 3
    up = s.view[:, 2] - 2 * np.einsum("ij,ij->i", s.normal, s.view) * s.normal[:, 2]
    scene = np.where(
        (up > 0)[:, None], np.array([0.35, 0.45, 0.6], np.float32), np.array([0.06, 0.06, 0.055], np.float32)
    )
    out = out * (1 - mirror[:, None]) + scene * mirror[:, None]
    frame = np.maximum(_lines(uv[:, 0], 0.73, 0.06, s.footprint), _lines(uv[:, 1], 1.31, 0.06, s.footprint))
    frame *= s.color.sum(1) > 0.13  # not on cars
    return out * (1 - frame[:, None]) + 0.6 * frame[:, None]


_PAINTERS = {
    Material.ASPHALT: _asphalt,
    Material.PAVING: _paving,
    Material.GRASS: _grass,
    Material.PLASTER: _plaster,
    Material.CONCRETE: _plaster,
    Material.BRICK: _brick,
    Material.ROOF: _roof,
    Material.WOOD: _wood,
    Material.TILE: _panels,
    Material.GLASS: _glass,
}
