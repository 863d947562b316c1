# SPDX-License-Identifier: Apache-2.0
"""Filters that remove dynamic objects, the ground, or traffic from a scan by a trained network, before the SLAM.

All later stages use only the remaining points: the choice of reference points and their descriptors, the registration
of the points, and the map.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dpm2_core.config import Settings
from dpm2_core.descriptors import levelling
from dpm2_core.errors import UsageError
from dpm2_core.frame import Points
from dpm2_core.geometry.tilt import tilt_of
from dpm2_core.network.pretrained import DYNAMIC, PERCEPTION_WEIGHTS, PRETRAINED_DIR, load_once

if TYPE_CHECKING:  # torch takes seconds to import, and the geometric SLAM does without
    from dpm2_core.network.perception.dslr import Dslr
    from dpm2_core.network.perception.dynamic_objects import DynamicObjectNet
    from dpm2_core.network.perception.gndnet import GroundNet

_MAX_REMOVED = 0.7  # fraction of a scan that is removed as moving at most: the most likely points
FilterKind = Literal["none", "movers", "ground", "static"]


class FilterSettings(Settings):
    """Which points of a scan are removed before all other stages."""

    kind: FilterKind = "none"
    """movers: removes things that move or could move. ground: removes the ground, by GndNet. static: removes what is in
    front of the scan that DSLR predicts without traffic."""
    weights: Path | None = None
    """Path of a .safetensors file; unset: the weights that come with dpm2."""


PointFilter = Callable[[Points], NDArray[np.bool_]]
"""Mask (N,) of the points (N, 4) float32 [x, y, z m, intensity 0..1] in the LiDAR frame to keep; may be all False."""


def without_dynamic_objects(net: DynamicObjectNet, points: Points) -> NDArray[np.bool_]:
    """Removes things that move or could move, up to a part of the scan; see `network.perception.dynamic_objects`."""
    if not len(points):
        return np.zeros(0, bool)
    probability = net.probability(points)
    # If hardly anything else is left, the network is wrong or lacks information: part of a scan is still a scan.
    bound = max(DYNAMIC, float(np.quantile(probability, 1 - _MAX_REMOVED)))
    return np.asarray(probability <= bound)


def without_ground(net: GroundNet, points: Points) -> NDArray[np.bool_]:
    """Removes the ground, and the points outside the grid of GndNet."""
    import torch

    from dpm2_core.network.perception.gndnet import obstacle_weight

    with torch.inference_mode():
        scan = torch.from_numpy(points)
        above = obstacle_weight(scan, net([scan])[0], net.settings) > 0.5
    return np.asarray(above.numpy())


def without_traffic(net: Dslr, points: Points) -> NDArray[np.bool_]:
    """Removes the points in front of the scan that DSLR predicts without traffic."""
    import torch

    return np.asarray(net.still(torch.from_numpy(points)).numpy())


def in_level_axes(point_filter: PointFilter, points: Points) -> NDArray[np.bool_]:
    """Apply a filter trained on level sensors to one that may be tilted, in the axes of the ground."""
    up = tilt_of(points)
    if up is None:
        return point_filter(points)
    return point_filter(np.column_stack([points[:, :3] @ levelling(up).T, points[:, 3]]))


def filter_weights(settings: FilterSettings) -> Path:
    """The weights file of a filter.

    Raises:
        UsageError: there is no such file.
    """
    shipped = PRETRAINED_DIR / f"{PERCEPTION_WEIGHTS[settings.kind]}.safetensors"
    path = Path(os.path.expanduser(str(settings.weights or shipped)))
    if not path.is_file():
        why = "no such file" if settings.weights else "none come with this dpm2"
        raise UsageError(
            f"slam.filter.weights: {why} ({path}); `dpm2 train {PERCEPTION_WEIGHTS[settings.kind]}` makes some"
        )
    return path


def make_filter(settings: FilterSettings, threads: int) -> PointFilter | None:
    """The filter of the settings; None for `none`. `threads` is torch's number of threads, one for the whole process.

    Raises:
        UsageError: no weights, or weights of another task.
    """
    if settings.kind == "none":
        return None
    return partial(in_level_axes, _load_filter(settings, filter_weights(settings), threads))


def _load_filter(settings: FilterSettings, path: Path, threads: int) -> PointFilter:
    """The filter with the weights of a file, for scans in level axes."""
    if settings.kind == "movers":
        from dpm2_core.network.perception import dynamic_objects

        movers = load_once(path, threads, dynamic_objects.load)
        return partial(without_dynamic_objects, movers)
    if settings.kind == "ground":
        from dpm2_core.network.perception import gndnet

        return partial(without_ground, load_once(path, threads, gndnet.load))
    from dpm2_core.network.perception import dslr

    return partial(without_traffic, load_once(path, threads, dslr.load))
