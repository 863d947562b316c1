# SPDX-License-Identifier: Apache-2.0
"""Classes of objects (SemanticKITTI) and their materials (optical properties)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Label(IntEnum):
    """SemanticKITTI class ids, as far as the worlds contain them."""

    OUTLIER = 1
    CAR = 10
    TRUCK = 18
    PERSON = 30
    BICYCLIST = 31
    ROAD = 40
    PARKING = 44
    SIDEWALK = 48
    OTHER_GROUND = 49
    BUILDING = 50
    FENCE = 51
    STRUCTURE = 52
    MARKING = 60
    VEGETATION = 70
    TRUNK = 71
    TERRAIN = 72
    POLE = 80
    SIGN = 81
    OBJECT = 99


MOVING_LABEL = np.arange(100, dtype=np.uint32)
"""(100,) SemanticKITTI id of a class when it moves: 10 becomes 252."""
for _static_id, _moving_id in {10: 252, 18: 258, 30: 254, 31: 253}.items():
    MOVING_LABEL[_static_id] = _moving_id


class Material(IntEnum):
    """Index into the property arrays of this module."""

    ASPHALT = 0
    PAVING = 1
    GRASS = 2
    SOIL = 3
    PLASTER = 4
    BRICK = 5
    GLASS = 6
    ROOF = 7
    BARK = 8
    LEAF = 9
    METAL = 10
    SIGN = 11
    PAINT = 12
    RUBBER = 13
    CONCRETE = 14
    WOOD = 15
    CLOTH = 16
    TILE = 17
    LAMP = 18


class Surface(NamedTuple):
    """Class, material and color (3,) 0..255 of a solid."""

    label: Label
    material: Material
    color: ArrayLike


@dataclass(frozen=True)
class _Optics:
    """Optical properties of one material.

    Attributes:
        reflectance: LiDAR intensity at normal incidence. miss: fraction of pulses without a return. dark: fraction of
            returns too weak to measure their intensity, which is then 0. roughness: additional range noise, m. retro:
            bright at any incidence.
    """

    reflectance: float
    miss: float = 0.0
    dark: float = 0.01
    roughness: float = 0.0
    retro: bool = False


_TABLE = {
    Material.ASPHALT: _Optics(0.33, dark=0.04),
    Material.PAVING: _Optics(0.38),
    Material.GRASS: _Optics(0.44, 0.01, 0.03, 0.03),
    Material.SOIL: _Optics(0.38, 0.0, 0.02, 0.015),
    Material.PLASTER: _Optics(0.52),
    Material.BRICK: _Optics(0.46),
    Material.GLASS: _Optics(0.15, 0.5, 0.6),
    Material.ROOF: _Optics(0.35, 0.02),
    Material.BARK: _Optics(0.38, 0.03, 0.05, 0.01),
    Material.LEAF: _Optics(0.46, 0.06, 0.03, 0.04),
    Material.METAL: _Optics(0.36, 0.08, 0.2),
    Material.SIGN: _Optics(0.95, retro=True),
    Material.PAINT: _Optics(0.3, 0.3, 0.35),
    Material.RUBBER: _Optics(0.1, 0.3, 0.5),
    Material.CONCRETE: _Optics(0.44),
    Material.WOOD: _Optics(0.42, 0.01, 0.05),
    Material.CLOTH: _Optics(0.38, 0.03, 0.1, 0.01),
    Material.TILE: _Optics(0.46, 0.01),
    Material.LAMP: _Optics(0.3, 0.3, 0.3),
}

REFLECTANCE = np.array([_TABLE[m].reflectance for m in Material], np.float32)
MISS = np.array([_TABLE[m].miss for m in Material], np.float32)
DARK = np.array([_TABLE[m].dark for m in Material], np.float32)
ROUGHNESS = np.array([_TABLE[m].roughness for m in Material], np.float32)
RETRO = np.array([_TABLE[m].retro for m in Material])
